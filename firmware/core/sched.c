// SPDX-License-Identifier: Apache-2.0
// Timers, tasks and the shutdown.
#include "boards/board.h"
#include "core/node.h"

#include <string.h>

DECL_STATIC_STRING(timer_too_close, "Timer too close");
DECL_STATIC_STRING(timer_in_past, "Rescheduled timer in the past");

DECL_RESPONSE(shutdown, "shutdown clock=%u static_string_id=%hu");

enum { TIMERS_AT_ONCE_MAX = 20000 };

static void insert(struct node *node, struct timer *timer) {
    struct timer **at = &node->sched.first;
    while (*at && !clock_before(timer->waketime, (*at)->waketime))
        at = &(*at)->next;
    timer->next = *at;
    *at = timer;
}

void sched_add_timer(struct node *node, struct timer *timer) {
    if (node->shutdown.active)
        return;
    if (clock_before(timer->waketime, board_clock(node))) {
        node_shutdown(node, STRING(timer_too_close));
        return;
    }
    insert(node, timer);
}

void sched_add_timer_in(struct node *node, struct timer *timer, uint32_t ticks) {
    if (node->shutdown.active)
        return;
    timer->waketime = board_clock(node) + ticks;
    insert(node, timer);
}

void sched_delete_timer(struct node *node, struct timer *timer) {
    for (struct timer **at = &node->sched.first; *at; at = &(*at)->next)
        if (*at == timer) {
            *at = timer->next;
            return;
        }
}

// On a chip the clock goes on while timers run, so that one which wants to run again and again at one clock
// is soon in the past. Boards that are infinitely fast have to count.
static int runs_away(struct node *node, uint32_t clock) {
    if (clock != node->sched.last_clock)
        node->sched.run_at_once = 0;
    node->sched.last_clock = clock;
    return ++node->sched.run_at_once > TIMERS_AT_ONCE_MAX;
}

void sched_run_first(struct node *node) {
    struct timer *timer = node->sched.first;
    if (runs_away(node, timer->waketime)) {
        node_shutdown(node, STRING(timer_in_past));
        return;
    }
    node->sched.first = timer->next;
    node->stats.timers_run++;
    enum timer_result result = timer->function(node, timer);
    if (result == TIMER_DONE || node->shutdown.active)
        return;
    if (clock_before(timer->waketime, board_clock(node) - node->config.timer_slack))
        node_shutdown(node, STRING(timer_in_past));
    else
        insert(node, timer);
}

void node_shutdown(struct node *node, uint16_t reason) {
    uint32_t irq = board_irq_save(node);
    node->sched.first = NULL;
    if (!node->shutdown.active) {
        node->shutdown.active = 1;
        node->shutdown.reported = 0;
        node->shutdown.reason = reason;
        node->shutdown.clock = board_clock(node);
        for (unsigned i = 0; i < node_tables.hook_count; i++)
            node_tables.hooks[i](node);
    }
    node_wake_tasks(node);
    board_irq_restore(node, irq);
}

void sched_report_shutdown_task(struct node *node) {
    if (!node->shutdown.active || node->shutdown.reported)
        return;
    if (!node_can_respond(node))
        return; // the transmit buffer empties itself and wakes the tasks
    node->shutdown.reported = 1;
    RESPOND(node, shutdown, INT(node->shutdown.clock), INT(node->shutdown.reason));
}
DECL_TASK(sched_report_shutdown_task);

void node_run_tasks(struct node *node) {
    do {
        node->tasks_pending = 0;
        uint32_t began = board_clock(node);
        for (unsigned i = 0; i < node_tables.task_count; i++)
            node_tables.tasks[i](node);
        uint32_t ticks = board_clock(node) - began;
        node->base.count++;
        node->base.sum += ticks;
        // Scaled by STATS_SUMSQ_BASE, so that five seconds of busy rounds fit into 32 bits.
        uint64_t square = ((uint64_t)ticks * ticks + 255) / 256;
        uint64_t sumsq = node->base.sumsq + square;
        node->base.sumsq = sumsq > UINT32_MAX ? UINT32_MAX : (uint32_t)sumsq;
    } while (node->tasks_pending);
}

uint32_t node_next_deadline(const struct node *node) {
    uint32_t deadline = node->base.report_clock + NODE_STATS_SECONDS * node->config.clock_freq;
    const struct timer *first = node->sched.first;
    if (node->alarm.set && clock_before(node->alarm.clock, deadline))
        deadline = node->alarm.clock;
    return first && clock_before(first->waketime, deadline) ? first->waketime : deadline;
}

void node_start(struct node *node, const struct node_config *config) {
    struct can_stream *can = node->can;
    memset(node, 0, sizeof(*node));
    node->config = *config;
    node->can = can;
    for (unsigned i = 0; i < node_tables.init_count; i++)
        node_tables.inits[i](node);
    node_wake_tasks(node);
}
