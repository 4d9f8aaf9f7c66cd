// SPDX-License-Identifier: Apache-2.0
// Timers: one list sorted by wake-up clock. A node has some ten of them, and a stepper's next step mostly
// goes back to the front, so a list beats any tree here.
#include "boards/board.h"
#include "core/node.h"

DECL_STATIC_STRING(timer_too_close, "Timer too close");
DECL_STATIC_STRING(timer_in_past, "Rescheduled timer in the past");

// Behind timers of the same clock: who came first runs first.
static void insert(struct node *node, struct timer *timer) {
    struct timer **at = &node->timers;
    while (*at && !clock_before(timer->wake_clock, (*at)->wake_clock))
        at = &(*at)->next;
    timer->next = *at;
    *at = timer;
}

void sched_add_timer(struct node *node, struct timer *timer) {
    uint32_t irq = board_irq_save(node);
    bool late = clock_before(timer->wake_clock, board_clock(node));
    if (!late) {
        if (node->running == timer)
            node->running = NULL;
        insert(node, timer);
    }
    board_irq_restore(node, irq);
    if (late)
        node_shutdown(node, string_timer_too_close);
}

void sched_del_timer(struct node *node, struct timer *timer) {
    uint32_t irq = board_irq_save(node);
    if (node->running == timer)
        node->running = NULL;
    for (struct timer **at = &node->timers; *at; at = &(*at)->next) {
        if (*at == timer) {
            *at = timer->next;
            break;
        }
    }
    board_irq_restore(node, irq);
}

// A timer with an interval of nothing would stop the world: so many runs at one clock are an error.
enum { STANDSTILL_MAX = 1000 };

void sched_dispatch(struct node *node) {
    struct timer *timer = node->timers;
    uint32_t due = timer->wake_clock;
    node->timers = timer->next;
    node->running = timer;
    enum timer_result result = timer->run(node, timer);
    bool again = result == TIMER_RESCHEDULE && node->running == timer;
    node->running = NULL;
    if (!again)
        return;
    node->standstill = timer->wake_clock == due ? node->standstill + 1 : 0;
    uint32_t latest = timer->wake_clock + node->config.timer_slack_ticks;
    if (clock_before(latest, board_clock(node)) || node->standstill > STANDSTILL_MAX) {
        node_shutdown(node, string_timer_in_past);
        return;
    }
    insert(node, timer);
}

void sched_reset(struct node *node) {
    uint32_t irq = board_irq_save(node);
    node->timers = NULL;
    node->running = NULL;
    board_irq_restore(node, irq);
}
