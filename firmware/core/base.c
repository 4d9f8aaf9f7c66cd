// SPDX-License-Identifier: Apache-2.0
// Commands that every node has: identification, time, life and death.
#include "boards/board.h"
#include "core/node.h"

DECL_CONSTANT("STATS_SUMSQ_BASE", 256);

DECL_STATIC_STRING(command_request, "Command request");
DECL_STATIC_STRING(not_shutdown, "Shutdown cleared when not shutdown");

DECL_RESPONSE(identify_response, "identify_response offset=%u data=%.*s");
DECL_RESPONSE(clock, "clock clock=%u");
DECL_RESPONSE(uptime, "uptime high=%u clock=%u");
DECL_RESPONSE(stats, "stats count=%u sum=%u sumsq=%u");
DECL_RESPONSE(starting, "starting");
DECL_RESPONSE(pong, "pong data=%*s");

enum { IDENTIFY_MAX = WIRE_CONTENT_MAX - 1 - WIRE_VLQ_MAX - 1 }; // what fits behind id, offset and length

// -------------------------------------------------------------------------------------------- identification

void command_identify(struct node *node, const struct wire_arg *args) {
    uint32_t offset = args[0].value, count = args[1].value;
    const uint8_t *text = node->config.dictionary;
    uint32_t size = node->config.dictionary_size;
    if (!text) {
        text = node_tables.dictionary;
        size = node_tables.dictionary_size;
    }
    uint32_t left = offset < size ? size - offset : 0;
    // More than fits into a block is cut: the host asks on from where the answer ended.
    if (count > IDENTIFY_MAX)
        count = IDENTIFY_MAX;
    if (count > left)
        count = left;
    RESPOND(node, identify_response, INT(offset), BYTES(text + (left ? offset : 0), count));
}
DECL_COMMAND(command_identify, "identify offset=%u count=%c", ALLOWED_IN_SHUTDOWN);

// ------------------------------------------------------------------------------------------------------ time

static uint32_t track_clock(struct node *node) {
    uint32_t now = board_clock(node);
    if (now < node->base.last_clock)
        node->base.clock_high++;
    node->base.last_clock = now;
    return now;
}

void command_get_clock(struct node *node, const struct wire_arg *args) {
    (void)args;
    RESPOND(node, clock, INT(board_clock(node)));
}
DECL_COMMAND(command_get_clock, "get_clock", ALLOWED_IN_SHUTDOWN | FREQUENT);

void command_get_uptime(struct node *node, const struct wire_arg *args) {
    (void)args;
    uint32_t now = track_clock(node);
    RESPOND(node, uptime, INT(node->base.clock_high), INT(now));
}
DECL_COMMAND(command_get_uptime, "get_uptime", ALLOWED_IN_SHUTDOWN);

void base_init(struct node *node) {
    node->base.starting = 1;
    node->base.clock_high = node->config.clock_high;
    node->base.report_clock = node->base.last_clock = board_clock(node);
}
DECL_INIT(base_init);

// Runs at least every NODE_STATS_SECONDS (node_next_deadline), far more often than the clock rolls over.
void base_stats_task(struct node *node) {
    uint32_t now = track_clock(node);
    if (node->base.starting) {
        node->base.starting = 0;
        RESPOND_EMPTY(node, starting);
    }
    if (now - node->base.report_clock < NODE_STATS_SECONDS * node->config.clock_freq)
        return;
    RESPOND(node, stats, INT(node->base.count), INT(node->base.sum), INT(node->base.sumsq));
    node->base.report_clock = now;
    node->base.count = node->base.sum = node->base.sumsq = 0;
}
DECL_TASK(base_stats_task);

// ---------------------------------------------------------------------------------------------- life and
// death

void command_emergency_stop(struct node *node, const struct wire_arg *args) {
    (void)args;
    node_shutdown(node, STRING(command_request));
}
DECL_COMMAND(command_emergency_stop, "emergency_stop", ALLOWED_IN_SHUTDOWN);

void command_clear_shutdown(struct node *node, const struct wire_arg *args) {
    (void)args;
    if (!node->shutdown.active) {
        node_shutdown(node, STRING(not_shutdown));
        return;
    }
    node->shutdown.active = 0;
}
DECL_COMMAND(command_clear_shutdown, "clear_shutdown", ALLOWED_IN_SHUTDOWN);

void command_reset(struct node *node, const struct wire_arg *args) {
    (void)args;
    board_reset(node);
}
DECL_COMMAND(command_reset, "reset", ALLOWED_IN_SHUTDOWN);

// ----------------------------------------------------------------------------------------------------- tests

void command_debug_ping(struct node *node, const struct wire_arg *args) {
    RESPOND(node, pong, BYTES(args[0].data, args[0].value));
}
DECL_COMMAND(command_debug_ping, "debug_ping data=%*s", ALLOWED_IN_SHUTDOWN);

void command_debug_nop(struct node *node, const struct wire_arg *args) {
    (void)node;
    (void)args;
}
DECL_COMMAND(command_debug_nop, "debug_nop", ALLOWED_IN_SHUTDOWN);
