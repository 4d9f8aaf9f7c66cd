// SPDX-License-Identifier: Apache-2.0
// Triggers by a sensor's readings: see trigger_analog.h.
//
// While it is armed each reading is filtered; from the clock of the command on the result is compared. A
// reading out of its range, one that the filter cannot take, a sensor that fails or that is silent for
// monitor_max checks in a row triggers at once, with the reason of an error: nobody knows the force then.
#include "objects/trigger_analog.h"

#include "boards/board.h"
#include "objects/sos_filter.h"
#include "objects/trsync.h"

DECL_STATIC_STRING(trigger_analog_kind, "Invalid trigger_analog_type");
DECL_STATIC_STRING(trigger_analog_monitor, "Invalid trigger_analog monitor_ticks");

// abs_ge: at the trigger value or further from 0; gt: above it; diff_peak_gt: below the highest one by more.
DECL_ENUMERATION("trigger_analog_type", "abs_ge", 0);
DECL_ENUMERATION("trigger_analog_type", "gt", 1);
DECL_ENUMERATION("trigger_analog_type", "diff_peak_gt", 2);
// What is added to the error_reason of trigger_analog_home; a sensor's own errors follow.
DECL_ENUMERATION("trigger_analog_error:", "RAW_RANGE", 0);
DECL_ENUMERATION("trigger_analog_error:", "OVERFLOW", 1);
DECL_ENUMERATION("trigger_analog_error:", "MONITOR", 2);
DECL_ENUMERATION("trigger_analog_error:", "SENSOR_SPECIFIC", 3);

DECL_RESPONSE(trigger_analog_state, "trigger_analog_state oid=%c homing=%c homing_clock=%u");

enum kind { ABS_GE, GT, DIFF_PEAK_GT, KINDS };
enum error { RAW_RANGE, OVERFLOW, MONITOR, SENSOR_SPECIFIC };

struct trigger_analog {
    struct timer timer; // of the monitor
    struct sos_filter *filter;
    struct trsync *trsync; // while it is armed
    uint32_t start_clock, trigger_clock, monitor_ticks;
    int32_t raw_min, raw_max, value, peak;
    uint8_t kind, homing, trigger_reason, error_reason;
    uint8_t heard, silent, monitor_max; // readings since the last check, checks without one
};

static const struct oid_type trigger_analog_type = {"trigger_analog"};

struct trigger_analog *trigger_analog_find(struct node *node, uint32_t oid) {
    return oid_find(node, oid, &trigger_analog_type);
}

static void trigger_at(struct node *node, struct trigger_analog *it, uint32_t clock, uint32_t reason) {
    uint32_t irq = board_irq_save(node);
    if (it->homing) {
        it->homing = 0;
        it->trigger_clock = clock;
        sched_delete_timer(node, &it->timer);
        trsync_trigger(node, it->trsync, (uint8_t)reason);
    }
    board_irq_restore(node, irq);
}

static enum timer_result monitor_event(struct node *node, struct timer *timer) {
    struct trigger_analog *it = (struct trigger_analog *)timer;
    it->silent = it->heard ? 0 : (uint8_t)(it->silent + 1);
    it->heard = 0;
    if (it->silent >= it->monitor_max) {
        it->homing = 0;
        it->trigger_clock = timer->waketime;
        trsync_trigger(node, it->trsync, (uint8_t)(it->error_reason + MONITOR));
        return TIMER_DONE;
    }
    timer->waketime += it->monitor_ticks;
    return TIMER_AGAIN;
}

static int has_triggered(struct trigger_analog *it, int32_t value) {
    switch (it->kind) {
    case ABS_GE:
        return value >= it->value || value <= -it->value;
    case GT:
        return value > it->value;
    default:
        if (value > it->peak)
            it->peak = value;
        return it->peak - value > it->value;
    }
}

void trigger_analog_add(struct node *node, struct trigger_analog *it, uint32_t clock, int32_t reading) {
    if (!it->homing)
        return;
    it->heard = 1;
    int32_t value;
    if (reading < it->raw_min || reading > it->raw_max)
        trigger_at(node, it, clock, it->error_reason + RAW_RANGE);
    else if (sos_filter_apply(it->filter, reading, &value))
        trigger_at(node, it, clock, it->error_reason + OVERFLOW);
    else if (!clock_before(clock, it->start_clock) && has_triggered(it, value))
        trigger_at(node, it, clock, it->trigger_reason);
}

void trigger_analog_fail(struct node *node, struct trigger_analog *it, uint32_t clock, uint8_t error) {
    trigger_at(node, it, clock, it->error_reason + (uint32_t)SENSOR_SPECIFIC + error);
}

// -------------------------------------------------------------------------------------------- commands

void command_config_trigger_analog(struct node *node, const struct wire_arg *args) {
    struct sos_filter *filter = sos_filter_find(node, args[1].value);
    if (!filter)
        return;
    struct trigger_analog *it = oid_create(node, args[0].value, &trigger_analog_type, sizeof(*it));
    if (!it)
        return;
    it->filter = filter;
    it->timer.function = monitor_event;
    it->raw_min = INT32_MIN;
    it->raw_max = INT32_MAX;
}
DECL_COMMAND(command_config_trigger_analog, "config_trigger_analog oid=%c sos_filter_oid=%c", 0);

void command_trigger_analog_set_raw_range(struct node *node, const struct wire_arg *args) {
    struct trigger_analog *it = trigger_analog_find(node, args[0].value);
    if (!it)
        return;
    it->raw_min = (int32_t)args[1].value;
    it->raw_max = (int32_t)args[2].value;
}
DECL_COMMAND(command_trigger_analog_set_raw_range,
             "trigger_analog_set_raw_range oid=%c raw_min=%i raw_max=%i", 0);

void command_trigger_analog_set_trigger(struct node *node, const struct wire_arg *args) {
    struct trigger_analog *it = trigger_analog_find(node, args[0].value);
    if (!it)
        return;
    if (args[1].value >= KINDS) {
        node_shutdown(node, STRING(trigger_analog_kind));
        return;
    }
    it->kind = (uint8_t)args[1].value;
    it->value = (int32_t)args[2].value;
}
DECL_COMMAND(command_trigger_analog_set_trigger,
             "trigger_analog_set_trigger oid=%c trigger_analog_type=%c trigger_value=%i", 0);

// From CLOCK on what the readings become may trigger the stop group; trigger_reason 0 ends that.
void command_trigger_analog_home(struct node *node, const struct wire_arg *args) {
    struct trigger_analog *it = trigger_analog_find(node, args[0].value);
    if (!it)
        return;
    uint32_t irq = board_irq_save(node);
    sched_delete_timer(node, &it->timer);
    it->homing = 0;
    board_irq_restore(node, irq);
    if (!args[2].value)
        return;
    struct trsync *trsync = trsync_find(node, args[1].value);
    if (!trsync)
        return;
    if (!args[5].value || args[5].value >= 1u << 31) {
        node_shutdown(node, STRING(trigger_analog_monitor));
        return;
    }
    it->trsync = trsync;
    it->trigger_reason = (uint8_t)args[2].value;
    it->error_reason = (uint8_t)args[3].value;
    it->start_clock = args[4].value;
    it->monitor_ticks = args[5].value;
    it->monitor_max = (uint8_t)args[6].value;
    it->peak = INT32_MIN / 2;
    it->heard = it->silent = 0;
    irq = board_irq_save(node);
    it->homing = 1;
    sched_add_timer_in(node, &it->timer, it->monitor_ticks);
    board_irq_restore(node, irq);
}
DECL_COMMAND(command_trigger_analog_home,
             "trigger_analog_home oid=%c trsync_oid=%c trigger_reason=%c error_reason=%c clock=%u "
             "monitor_ticks=%u monitor_max=%u",
             0);

void command_trigger_analog_query_state(struct node *node, const struct wire_arg *args) {
    const struct trigger_analog *it = trigger_analog_find(node, args[0].value);
    if (it)
        RESPOND(node, trigger_analog_state, INT(args[0].value), INT(it->homing), INT(it->trigger_clock));
}
DECL_COMMAND(command_trigger_analog_query_state, "trigger_analog_query_state oid=%c", 0);

void trigger_analog_shutdown(struct node *node) {
    struct trigger_analog *it;
    for (unsigned oid = 0; (it = oid_next(node, &oid, &trigger_analog_type));) {
        sched_delete_timer(node, &it->timer);
        it->homing = 0;
    }
}
DECL_SHUTDOWN_HOOK(trigger_analog_shutdown);
