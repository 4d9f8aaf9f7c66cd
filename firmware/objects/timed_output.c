// SPDX-License-Identifier: Apache-2.0
// Queue and safety net of timed outputs.
#include "objects/timed_output.h"

#include "boards/board.h"

// Finds what happens next; false when nothing does.
static bool plan(struct timed_output *out) {
    bool any = out->queue.first || out->has_deadline;
    if (any)
        out->timer.wake_clock = out->queue.first ? out->queue.first->output.clock : out->deadline;
    if (out->has_between && (!any || clock_before(out->between_clock, out->timer.wake_clock))) {
        out->timer.wake_clock = out->between_clock;
        any = true;
    }
    return any;
}

static void apply(struct node *node, struct timed_output *out, uint32_t value, uint32_t clock) {
    out->has_between = false;
    bool is_default = out->kind->apply(node, out, value, clock);
    out->has_deadline = out->max_duration && !is_default;
    out->deadline = clock + out->max_duration;
}

// Tells whether CLOCK comes too late to renew the present value.
static bool exceeds(const struct timed_output *out, uint32_t clock) {
    return out->has_deadline && clock_before(out->deadline, clock);
}

static enum timer_result run(struct node *node, struct timer *timer) {
    struct timed_output *out = (struct timed_output *)(void *)timer;
    uint32_t now = timer->wake_clock;
    const struct move *first = out->queue.first;
    if (first && first->output.clock == now) {
        struct move *move = move_pop(&out->queue);
        apply(node, out, move->output.value, now);
        move_free(node, move);
        if (out->queue.first && exceeds(out, out->queue.first->output.clock)) {
            node_shutdown(node, *out->kind->exceeds);
            return TIMER_DONE;
        }
    } else if (out->has_between && out->between_clock == now) {
        out->kind->between(node, out, now);
    } else {
        node_shutdown(node, *out->kind->missed);
        return TIMER_DONE;
    }
    return plan(out) ? TIMER_RESCHEDULE : TIMER_DONE;
}

// Puts the timer where the changed queue wants it.
static void replan(struct node *node, struct timed_output *out) {
    sched_del_timer(node, &out->timer);
    if (plan(out))
        sched_add_timer(node, &out->timer);
}

void timed_output_setup(struct timed_output *out, const struct timed_output_kind *kind,
                        uint32_t max_duration) {
    out->kind = kind;
    out->timer.run = run;
    out->max_duration = max_duration;
}

void timed_output_queue(struct node *node, struct timed_output *out, uint32_t clock, uint32_t value) {
    struct move *move = move_alloc(node);
    if (!move)
        return;
    move->output.clock = clock;
    move->output.value = value;
    uint32_t irq = board_irq_save(node);
    bool first = !out->queue.first;
    bool late = first && exceeds(out, clock);
    move_push(&out->queue, move);
    if (first && !late)
        replan(node, out);
    board_irq_restore(node, irq);
    if (late)
        node_shutdown(node, *out->kind->exceeds);
}

void timed_output_set(struct node *node, struct timed_output *out, uint32_t value) {
    uint32_t irq = board_irq_save(node);
    apply(node, out, value, board_clock(node));
    replan(node, out);
    board_irq_restore(node, irq);
}

void timed_output_stop(struct node *node, struct timed_output *out) {
    sched_del_timer(node, &out->timer);
    move_clear(node, &out->queue);
    out->has_between = out->has_deadline = false;
}
