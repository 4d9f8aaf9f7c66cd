// SPDX-License-Identifier: Apache-2.0
// Timed outputs: see timed_output.h.
#include "objects/timed_output.h"

#include "boards/board.h"

struct value_move {
    struct move link;
    uint32_t clock, value;
};
_Static_assert(sizeof(struct value_move) <= NODE_MOVE_SIZE, "a value fits into a slot");

// Drives VALUE from CLOCK on and begins its period of grace.
static void drive(struct node *node, struct timed_output *output, uint32_t clock, uint32_t value) {
    output->apply(node, output, clock, value);
    output->has_end = output->max_duration && value != output->default_value;
    output->end_clock = clock + output->max_duration;
}

// Sets the timer to what comes next. Returns 0 when nothing does, or after a shutdown.
static int plan(struct node *node, struct timed_output *output) {
    const struct value_move *next = (const struct value_move *)output->queue.first;
    if (!next) {
        output->timer.waketime = output->end_clock;
        return output->has_end;
    }
    if (output->has_end && clock_before(output->end_clock, next->clock)) {
        node_shutdown(node, output->exceeded);
        return 0;
    }
    output->timer.waketime = next->clock;
    return 1;
}

static enum timer_result event(struct node *node, struct timer *timer) {
    struct timed_output *output = (struct timed_output *)timer;
    struct value_move *move = (struct value_move *)move_queue_pop(&output->queue);
    if (!move) {
        node_shutdown(node, output->missed);
        return TIMER_DONE;
    }
    drive(node, output, move->clock, move->value);
    move_free(node, move);
    return plan(node, output) ? TIMER_AGAIN : TIMER_DONE;
}

void timed_output_init(struct timed_output *output) {
    output->timer.function = event;
}

void timed_output_queue(struct node *node, struct timed_output *output, uint32_t clock, uint32_t value) {
    struct value_move *move = move_alloc(node);
    if (!move)
        return;
    move->clock = clock;
    move->value = value;
    if (!move_queue_push(&output->queue, &move->link))
        return; // judged when its turn comes
    sched_delete_timer(node, &output->timer);
    if (plan(node, output))
        sched_add_timer(node, &output->timer);
}

void timed_output_update(struct node *node, struct timed_output *output, uint32_t value) {
    sched_delete_timer(node, &output->timer);
    drive(node, output, board_clock(node), value);
    if (plan(node, output))
        sched_add_timer(node, &output->timer);
}

void timed_output_stop(struct node *node, struct timed_output *output) {
    sched_delete_timer(node, &output->timer);
    move_queue_clear(node, &output->queue);
    output->has_end = 0;
    output->apply(node, output, board_clock(node), output->default_value);
}
