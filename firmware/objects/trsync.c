// SPDX-License-Identifier: Apache-2.0
// Stop groups: see trsync.h. While one is armed it reports itself periodically, which is also how the host
// learns that the node is alive and may push the time-out further.
#include "objects/trsync.h"

#include "boards/board.h"
#include "core/bus_signals.h"

DECL_STATIC_STRING(invalid_group, "Not a valid trigger group");
DECL_STATIC_STRING(already_joined, "Can't add signal that is already active");

DECL_RESPONSE(trsync_state, "trsync_state oid=%c can_trigger=%c trigger_reason=%c clock=%u");

struct trsync {
    struct timer report_timer, expire_timer;
    struct trsync_member *members;
    uint32_t report_ticks, report_clock;
    uint8_t can_trigger, reason, expire_reason, must_report;
    uint8_t group; // on the bus, or TRIGGER_GROUP_NONE
};

static const struct oid_type trsync_type = {"trsync"};

struct trsync *trsync_find(struct node *node, uint32_t oid) {
    return oid_find(node, oid, &trsync_type);
}

static void stop_member(struct node *node, struct trsync_member *member) {
    void (*stop)(struct node *node, struct trsync_member *member) = member->stop;
    member->stop = NULL;
    stop(node, member);
}

static void stop_members(struct node *node, struct trsync *trsync) {
    struct trsync_member *member = trsync->members;
    trsync->members = NULL;
    while (member) {
        struct trsync_member *next = member->next;
        stop_member(node, member);
        member = next;
    }
}

static void trigger_alone(struct node *node, struct trsync *trsync, uint8_t reason) {
    trsync->can_trigger = 0;
    trsync->reason = reason;
    trsync->report_clock = board_clock(node);
    stop_members(node, trsync);
    trsync->must_report = 1;
    node_wake_tasks(node);
}

void trsync_trigger(struct node *node, struct trsync *trsync, uint8_t reason) {
    if (!trsync->can_trigger)
        return;
    trigger_alone(node, trsync, reason);
    if (trsync->group == TRIGGER_GROUP_NONE)
        return;
    bus_signals_trigger(node, trsync->group, reason, trsync->report_clock);
    trsync_trigger_group(node, trsync->group, reason); // a node does not hear its own frames
}

void trsync_trigger_group(struct node *node, uint8_t group, uint8_t reason) {
    struct trsync *trsync;
    for (unsigned oid = 0; (trsync = oid_next(node, &oid, &trsync_type));)
        if (trsync->can_trigger && trsync->group == group)
            trigger_alone(node, trsync, reason);
}

// A member of two would link their lists, which may then have no end.
void trsync_join(struct node *node, struct trsync *trsync, struct trsync_member *member,
                 void (*stop)(struct node *node, struct trsync_member *member)) {
    if (member->stop) {
        node_shutdown(node, STRING(already_joined));
        return;
    }
    member->stop = stop;
    if (!trsync->can_trigger) {
        stop_member(node, member);
        return;
    }
    member->next = trsync->members;
    trsync->members = member;
}

static enum timer_result report_event(struct node *node, struct timer *timer) {
    struct trsync *trsync = (struct trsync *)((char *)timer - offsetof(struct trsync, report_timer));
    if (!trsync->can_trigger)
        return TIMER_DONE;
    trsync->report_clock = timer->waketime;
    trsync->must_report = 1;
    node_wake_tasks(node);
    timer->waketime += trsync->report_ticks;
    return TIMER_AGAIN;
}

static enum timer_result expire_event(struct node *node, struct timer *timer) {
    struct trsync *trsync = (struct trsync *)((char *)timer - offsetof(struct trsync, expire_timer));
    trsync_trigger(node, trsync, trsync->expire_reason);
    return TIMER_DONE;
}

void command_config_trsync(struct node *node, const struct wire_arg *args) {
    struct trsync *trsync = oid_create(node, args[0].value, &trsync_type, sizeof(*trsync));
    if (!trsync)
        return;
    trsync->report_timer.function = report_event;
    trsync->expire_timer.function = expire_event;
    trsync->group = TRIGGER_GROUP_NONE;
}
DECL_COMMAND(command_config_trsync, "config_trsync oid=%c", 0);

void command_trsync_start(struct node *node, const struct wire_arg *args) {
    struct trsync *trsync = trsync_find(node, args[0].value);
    if (!trsync)
        return;
    uint32_t irq = board_irq_save(node);
    sched_delete_timer(node, &trsync->report_timer);
    sched_delete_timer(node, &trsync->expire_timer);
    stop_members(node, trsync); // of an earlier round that nobody ended
    if (trsync->group != TRIGGER_GROUP_NONE)
        bus_signals_forget_trigger(node, trsync->group);
    trsync->can_trigger = 1;
    trsync->reason = trsync->must_report = 0;
    trsync->report_timer.waketime = args[1].value;
    trsync->report_ticks = args[2].value;
    trsync->expire_reason = (uint8_t)args[3].value;
    if (trsync->report_ticks)
        sched_add_timer(node, &trsync->report_timer);
    board_irq_restore(node, irq);
}
DECL_COMMAND(command_trsync_start, "trsync_start oid=%c report_clock=%u report_ticks=%u expire_reason=%c", 0);

void command_trsync_set_timeout(struct node *node, const struct wire_arg *args) {
    struct trsync *trsync = trsync_find(node, args[0].value);
    if (!trsync)
        return;
    uint32_t irq = board_irq_save(node);
    sched_delete_timer(node, &trsync->expire_timer);
    trsync->expire_timer.waketime = args[1].value;
    if (trsync->can_trigger)
        sched_add_timer(node, &trsync->expire_timer);
    board_irq_restore(node, irq);
}
DECL_COMMAND(command_trsync_set_timeout, "trsync_set_timeout oid=%c clock=%u", 0);

void command_trsync_set_group(struct node *node, const struct wire_arg *args) {
    struct trsync *trsync = trsync_find(node, args[0].value);
    if (!trsync)
        return;
    if (args[1].value >= TRIGGER_GROUPS && args[1].value != TRIGGER_GROUP_NONE) {
        node_shutdown(node, STRING(invalid_group));
        return;
    }
    trsync->group = (uint8_t)args[1].value;
}
DECL_COMMAND(command_trsync_set_group, "trsync_set_group oid=%c group=%c", 0);

static void report(struct node *node, uint32_t oid, struct trsync *trsync) {
    trsync->must_report = 0;
    RESPOND(node, trsync_state, INT(oid), INT(trsync->can_trigger), INT(trsync->reason),
            INT(trsync->report_clock));
}

// The host ends a round with this: it is answered even when something else triggered first.
void command_trsync_trigger(struct node *node, const struct wire_arg *args) {
    struct trsync *trsync = trsync_find(node, args[0].value);
    if (!trsync)
        return;
    uint32_t irq = board_irq_save(node);
    trsync_trigger(node, trsync, (uint8_t)args[1].value); // its timers find that the round is over
    board_irq_restore(node, irq);
    report(node, args[0].value, trsync);
}
DECL_COMMAND(command_trsync_trigger, "trsync_trigger oid=%c reason=%c", 0);

void trsync_task(struct node *node) {
    struct trsync *trsync;
    for (unsigned oid = 0; (trsync = oid_next(node, &oid, &trsync_type));)
        if (trsync->must_report && node_can_respond(node))
            report(node, oid - 1, trsync);
}
DECL_TASK(trsync_task);

void trsync_shutdown(struct node *node) {
    struct trsync *trsync;
    for (unsigned oid = 0; (trsync = oid_next(node, &oid, &trsync_type));) {
        trsync->can_trigger = 0;
        trsync->must_report = 0;
        stop_members(node, trsync);
    }
}
DECL_SHUTDOWN_HOOK(trsync_shutdown);
