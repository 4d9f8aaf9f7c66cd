// SPDX-License-Identifier: Apache-2.0
// Stop groups (trsync).
#include "objects/trsync.h"

#include "boards/board.h"

struct trsync {
    struct timer report_timer, expire_timer; // first: timers lead back to the object
    uint32_t report_ticks, report_clock;
    struct trsync_signal *signals;
    uint8_t reason, expire_reason;
    bool can_trigger, has_triggered, report_due;
};

static const struct oid_type trsync_type = {"trsync"};
DECL_STATIC_STRING(signal_active, "Can't add signal that is already active");
DECL_RESPONSE(trsync_state, "trsync_state oid=%c can_trigger=%c trigger_reason=%c clock=%u");

DECL_TASK(trsync_task);
void trsync_task(struct node *node) {
    uint16_t oid = 0;
    struct trsync *group;
    while ((group = oid_next(node, &trsync_type, &oid))) {
        uint32_t irq = board_irq_save(node);
        bool due = group->report_due, can_trigger = group->can_trigger;
        uint32_t clock = group->report_clock;
        group->report_due = false;
        board_irq_restore(node, irq);
        if (due)
            RESPOND(node, trsync_state, ARG(oid - 1), ARG(can_trigger), ARG(group->reason), ARG(clock));
    }
}

static void report(struct node *node, struct trsync *group, uint32_t clock) {
    group->report_clock = clock;
    group->report_due = true;
    WAKE(node, trsync_task);
}

void trsync_fire(struct node *node, struct trsync *group, uint8_t reason) {
    if (!group->can_trigger)
        return;
    group->can_trigger = false;
    group->has_triggered = true;
    group->reason = reason;
    sched_del_timer(node, &group->report_timer);
    sched_del_timer(node, &group->expire_timer);
    while (group->signals) {
        struct trsync_signal *signal = group->signals;
        group->signals = signal->next;
        signal->joined = false;
        signal->stop(node, signal);
    }
    report(node, group, board_clock(node));
}

void trsync_join(struct node *node, struct trsync *group, struct trsync_signal *signal) {
    uint32_t irq = board_irq_save(node);
    bool twice = signal->joined, late = group->has_triggered;
    if (!twice && !late) {
        signal->joined = true;
        signal->next = group->signals;
        group->signals = signal;
    }
    board_irq_restore(node, irq);
    if (twice)
        node_shutdown(node, string_signal_active);
    else if (late)
        signal->stop(node, signal);
}

struct trsync *trsync_lookup(struct node *node, uint8_t oid) {
    return oid_lookup(node, oid, &trsync_type);
}

static enum timer_result report_run(struct node *node, struct timer *timer) {
    struct trsync *group = (struct trsync *)((char *)timer - offsetof(struct trsync, report_timer));
    report(node, group, timer->wake_clock);
    timer->wake_clock += group->report_ticks;
    return TIMER_RESCHEDULE;
}

static enum timer_result expire_run(struct node *node, struct timer *timer) {
    struct trsync *group = (struct trsync *)((char *)timer - offsetof(struct trsync, expire_timer));
    trsync_fire(node, group, group->expire_reason);
    return TIMER_DONE;
}

DECL_COMMAND(command_config_trsync, "config_trsync oid=%c");
void command_config_trsync(struct node *node, const struct wire_arg *args) {
    struct trsync *group = oid_alloc(node, (uint8_t)args[0].value, &trsync_type, sizeof(*group));
    if (!group)
        return;
    group->report_timer.run = report_run;
    group->expire_timer.run = expire_run;
}

DECL_COMMAND(command_trsync_start, "trsync_start oid=%c report_clock=%u report_ticks=%u expire_reason=%c");
void command_trsync_start(struct node *node, const struct wire_arg *args) {
    struct trsync *group = trsync_lookup(node, (uint8_t)args[0].value);
    if (!group)
        return;
    uint32_t irq = board_irq_save(node);
    sched_del_timer(node, &group->report_timer);
    sched_del_timer(node, &group->expire_timer);
    group->report_due = false;
    group->can_trigger = true;
    group->has_triggered = false;
    group->reason = 0;
    group->report_timer.wake_clock = args[1].value;
    group->report_ticks = args[2].value;
    group->expire_reason = (uint8_t)args[3].value;
    if (group->report_ticks)
        sched_add_timer(node, &group->report_timer);
    board_irq_restore(node, irq);
}

DECL_COMMAND(command_trsync_set_timeout, "trsync_set_timeout oid=%c clock=%u");
void command_trsync_set_timeout(struct node *node, const struct wire_arg *args) {
    struct trsync *group = trsync_lookup(node, (uint8_t)args[0].value);
    if (!group)
        return;
    uint32_t irq = board_irq_save(node);
    sched_del_timer(node, &group->expire_timer);
    group->expire_timer.wake_clock = args[1].value;
    if (group->can_trigger)
        sched_add_timer(node, &group->expire_timer);
    board_irq_restore(node, irq);
}

DECL_COMMAND(command_trsync_trigger, "trsync_trigger oid=%c reason=%c");
void command_trsync_trigger(struct node *node, const struct wire_arg *args) {
    struct trsync *group = trsync_lookup(node, (uint8_t)args[0].value);
    if (!group)
        return;
    uint32_t irq = board_irq_save(node);
    if (group->can_trigger)
        trsync_fire(node, group, (uint8_t)args[1].value);
    else
        report(node, group, board_clock(node)); // the asker learns that, and why, it had triggered before
    board_irq_restore(node, irq);
}

DECL_SHUTDOWN_HOOK(trsync_shutdown);
void trsync_shutdown(struct node *node) {
    uint16_t oid = 0;
    struct trsync *group;
    while ((group = oid_next(node, &trsync_type, &oid))) {
        group->can_trigger = group->report_due = false;
        for (struct trsync_signal *signal = group->signals; signal; signal = signal->next)
            signal->joined = false; // the members stop by their own shutdown hooks
        group->signals = NULL;
    }
}
