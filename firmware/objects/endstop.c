// SPDX-License-Identifier: Apache-2.0
// Endstops: sample a pin at rest_ticks; when it has the wanted level, look sample_count times at sample_ticks
// and, if it stays so, trigger the stop group. next_clock - rest_ticks of the report is when the first of
// those was.
#include "boards/board.h"
#include "objects/trsync.h"

DECL_STATIC_STRING(invalid_input_pin, "Not a valid input pin");

DECL_RESPONSE(endstop_state, "endstop_state oid=%c homing=%c next_clock=%u pin_value=%c");

struct endstop {
    struct timer timer;
    struct trsync *trsync;
    uint32_t pin, sample_ticks, rest_ticks;
    uint32_t next_clock; // of the next look after this round of samples
    uint8_t sample_count, samples_left, wanted, homing, reason;
};

static const struct oid_type endstop_type = {"endstop"};

static enum timer_result sample_event(struct node *node, struct timer *timer) {
    struct endstop *endstop = (struct endstop *)timer;
    int resting = endstop->samples_left == endstop->sample_count;
    if (resting)
        endstop->next_clock = timer->waketime + endstop->rest_ticks;
    if (board_gpio_read(node, endstop->pin) != endstop->wanted) {
        endstop->samples_left = endstop->sample_count;
        timer->waketime = endstop->next_clock;
        return TIMER_AGAIN;
    }
    if (--endstop->samples_left == 0) {
        endstop->homing = 0;
        trsync_trigger(node, endstop->trsync, endstop->reason);
        return TIMER_DONE;
    }
    timer->waketime += endstop->sample_ticks;
    return TIMER_AGAIN;
}

void command_config_endstop(struct node *node, const struct wire_arg *args) {
    if (board_gpio_in(node, args[1].value, (int8_t)args[2].value)) {
        node_shutdown(node, STRING(invalid_input_pin));
        return;
    }
    struct endstop *endstop = oid_create(node, args[0].value, &endstop_type, sizeof(*endstop));
    if (!endstop)
        return;
    endstop->pin = args[1].value;
    endstop->timer.function = sample_event;
}
DECL_COMMAND(command_config_endstop, "config_endstop oid=%c pin=%c pull_up=%c", 0);

static void start(struct node *node, struct endstop *endstop, const struct wire_arg *args) {
    endstop->trsync = trsync_find(node, args[6].value);
    if (!endstop->trsync)
        return;
    endstop->timer.waketime = endstop->next_clock = args[1].value;
    endstop->sample_ticks = args[2].value;
    endstop->sample_count = endstop->samples_left = (uint8_t)args[3].value;
    endstop->rest_ticks = args[4].value;
    endstop->wanted = args[5].value != 0;
    endstop->reason = (uint8_t)args[7].value;
    endstop->homing = 1;
    sched_add_timer(node, &endstop->timer);
}

void command_endstop_home(struct node *node, const struct wire_arg *args) {
    struct endstop *endstop = oid_find(node, args[0].value, &endstop_type);
    if (!endstop)
        return;
    uint32_t irq = board_irq_save(node);
    sched_delete_timer(node, &endstop->timer);
    endstop->homing = 0;
    if (args[3].value) // else it ends here, and a host may still ask when the last look was
        start(node, endstop, args);
    board_irq_restore(node, irq);
}
DECL_COMMAND(command_endstop_home,
             "endstop_home oid=%c clock=%u sample_ticks=%u sample_count=%c rest_ticks=%u pin_value=%c "
             "trsync_oid=%c trigger_reason=%c",
             0);

void command_endstop_query_state(struct node *node, const struct wire_arg *args) {
    struct endstop *endstop = oid_find(node, args[0].value, &endstop_type);
    if (!endstop)
        return;
    uint32_t irq = board_irq_save(node);
    uint8_t homing = endstop->homing;
    uint32_t next_clock = endstop->next_clock;
    board_irq_restore(node, irq);
    RESPOND(node, endstop_state, INT(args[0].value), INT(homing), INT(next_clock),
            INT(board_gpio_read(node, endstop->pin)));
}
DECL_COMMAND(command_endstop_query_state, "endstop_query_state oid=%c", 0);

void endstop_shutdown(struct node *node) {
    struct endstop *endstop;
    for (unsigned oid = 0; (endstop = oid_next(node, &oid, &endstop_type));) {
        sched_delete_timer(node, &endstop->timer);
        endstop->homing = 0;
    }
}
DECL_SHUTDOWN_HOOK(endstop_shutdown);
