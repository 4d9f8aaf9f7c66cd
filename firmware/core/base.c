// SPDX-License-Identifier: Apache-2.0
// The commands every node has: dictionary, configuration, clock, shutdown, load figures.
#include "core/base.h"

#include "boards/board.h"
#include "core/memory.h"

DECL_CONSTANT("STATS_SUMSQ_BASE", 256);
_Static_assert(STATS_SUMSQ_BASE == 256, "the constant above is what the host divides by");
DECL_STATIC_STRING(command_request, "Command request");
DECL_STATIC_STRING(not_shutdown, "Shutdown cleared when not shutdown");
DECL_STATIC_STRING(reset_not_shutdown, "config_reset only available when shutdown");

// ---------------------------------------------------------------------------------------------- dictionary

// The most bytes of dictionary that fit beside id, offset and length whatever their sizes.
enum { IDENTIFY_MAX = WIRE_CONTENT_MAX - 1 - WIRE_VLQ_MAX - 1 };

DECL_RESPONSE(identify_response, "identify_response offset=%u data=%.*s");
DECL_COMMAND_FLAGS(command_identify, COMMAND_IN_SHUTDOWN, "identify offset=%u count=%c");
void command_identify(struct node *node, const struct wire_arg *args) {
    uint32_t offset = args[0].value, count = args[1].value, size = node->config.dictionary_size;
    if (count > IDENTIFY_MAX)
        count = IDENTIFY_MAX;
    uint32_t from = offset < size ? offset : size;
    if (count > size - from)
        count = size - from;
    RESPOND(node, identify_response, ARG(offset), ARG_BYTES(node->config.dictionary + from, count));
}

// ------------------------------------------------------------------------------------------- configuration

DECL_RESPONSE(config, "config is_config=%c crc=%u is_shutdown=%c move_count=%hu");
DECL_COMMAND_FLAGS(command_get_config, COMMAND_IN_SHUTDOWN, "get_config");
void command_get_config(struct node *node, const struct wire_arg *args) {
    (void)args;
    RESPOND(node, config, ARG(node->is_configured), ARG(node->config_crc), ARG(node->is_shutdown),
            ARG(node->move_count));
}

DECL_COMMAND(command_allocate_oids, "allocate_oids count=%c");
void command_allocate_oids(struct node *node, const struct wire_arg *args) {
    oids_allocate(node, (uint8_t)args[0].value);
}

DECL_STATIC_STRING(already_finalized, "Already finalized");
DECL_COMMAND(command_finalize_config, "finalize_config crc=%u");
void command_finalize_config(struct node *node, const struct wire_arg *args) {
    if (node->is_configured) {
        node_shutdown(node, string_already_finalized);
        return;
    }
    moves_allocate(node);
    node->config_crc = args[0].value;
    node->is_configured = true;
}

DECL_COMMAND_FLAGS(command_config_reset, COMMAND_IN_SHUTDOWN, "config_reset");
void command_config_reset(struct node *node, const struct wire_arg *args) {
    (void)args;
    if (!node->is_shutdown) {
        node_shutdown(node, string_reset_not_shutdown);
        return;
    }
    node_reset_config(node);
    node->is_shutdown = false;
}

// --------------------------------------------------------------------------------------------------- clock

// Counts rollovers; called at least once per housekeeping period, which is far shorter than one turn.
static void follow_clock(struct node *node, uint32_t clock) {
    if (clock < node->uptime_last)
        node->uptime_high++;
    node->uptime_last = clock;
}

DECL_RESPONSE(clock, "clock clock=%u");
DECL_COMMAND_FLAGS(command_get_clock, COMMAND_IN_SHUTDOWN | COMMAND_FREQUENT, "get_clock");
void command_get_clock(struct node *node, const struct wire_arg *args) {
    (void)args;
    RESPOND(node, clock, ARG(board_clock(node)));
}

DECL_RESPONSE(uptime, "uptime high=%u clock=%u");
DECL_COMMAND_FLAGS(command_get_uptime, COMMAND_IN_SHUTDOWN, "get_uptime");
void command_get_uptime(struct node *node, const struct wire_arg *args) {
    (void)args;
    uint32_t irq = board_irq_save(node);
    follow_clock(node, board_clock(node));
    uint32_t high = node->uptime_high, clock = node->uptime_last;
    board_irq_restore(node, irq);
    RESPOND(node, uptime, ARG(high), ARG(clock));
}

// ------------------------------------------------------------------------------------------------ shutdown

DECL_COMMAND_FLAGS(command_emergency_stop, COMMAND_IN_SHUTDOWN, "emergency_stop");
void command_emergency_stop(struct node *node, const struct wire_arg *args) {
    (void)args;
    node_shutdown(node, string_command_request);
}

DECL_COMMAND_FLAGS(command_clear_shutdown, COMMAND_IN_SHUTDOWN, "clear_shutdown");
void command_clear_shutdown(struct node *node, const struct wire_arg *args) {
    (void)args;
    if (!node->is_shutdown) {
        node_shutdown(node, string_not_shutdown);
        return;
    }
    node->is_shutdown = false;
}

DECL_COMMAND_FLAGS(command_reset, COMMAND_IN_SHUTDOWN, "reset");
void command_reset(struct node *node, const struct wire_arg *args) {
    (void)args;
    board_request_reset(node);
}

DECL_RESPONSE(shutdown, "shutdown clock=%u static_string_id=%hu");
DECL_TASK(shutdown_report_task);
void shutdown_report_task(struct node *node) {
    RESPOND(node, shutdown, ARG(node->shutdown_clock), ARG(node->shutdown_reason));
}

void base_report_shutdown(struct node *node) {
    WAKE(node, shutdown_report_task);
}

// --------------------------------------------------------------------------------------------------- debug

DECL_RESPONSE(pong, "pong data=%*s");
DECL_COMMAND_FLAGS(command_debug_ping, COMMAND_IN_SHUTDOWN, "debug_ping data=%*s");
void command_debug_ping(struct node *node, const struct wire_arg *args) {
    RESPOND(node, pong, ARG_BYTES(args[0].data, args[0].value));
}

DECL_COMMAND_FLAGS(command_debug_nop, COMMAND_IN_SHUTDOWN, "debug_nop");
void command_debug_nop(struct node *node, const struct wire_arg *args) {
    (void)node;
    (void)args;
}

// -------------------------------------------------------------------------------------------- housekeeping

DECL_RESPONSE(stats, "stats count=%u sum=%u sumsq=%u");
DECL_TASK(stats_task);
void stats_task(struct node *node) {
    RESPOND(node, stats, ARG(node->load_count), ARG(node->load_sum), ARG(node->load_sumsq));
    node->load_count = node->load_sum = node->load_sumsq = 0;
}

DECL_RESPONSE(starting, "starting");
DECL_TASK(starting_task);
void starting_task(struct node *node) {
    RESPOND(node, starting);
}

// Once a second: 5 s would come close to half a turn of a fast chip's clock, beyond which clocks do not
// compare.
static enum timer_result housekeeping_run(struct node *node, struct timer *timer) {
    follow_clock(node, board_clock(node));
    timer->wake_clock += node->config.clock_freq;
    if (++node->load_periods == STATS_PERIOD_S) {
        node->load_periods = 0;
        WAKE(node, stats_task);
    }
    return TIMER_RESCHEDULE;
}

void base_restart_housekeeping(struct node *node) {
    node->housekeeping.run = housekeeping_run;
    node->housekeeping.wake_clock = board_clock(node) + node->config.clock_freq;
    sched_add_timer(node, &node->housekeeping);
}

void base_start(struct node *node) {
    node->uptime_high = node->config.uptime_high;
    node->uptime_last = board_clock(node);
    base_restart_housekeeping(node);
    WAKE(node, starting_task);
}
