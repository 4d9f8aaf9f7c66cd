// SPDX-License-Identifier: Apache-2.0
// Buttons: up to eight pins sampled every rest_ticks. A state that two samples in a row agree on is an event;
// events are reported until the host acknowledges them, anew every retransmit_count samples.
#include "boards/board.h"

#include <string.h>

DECL_STATIC_STRING(buttons_max, "Max of 8 buttons");
DECL_STATIC_STRING(buttons_position, "Set button past maximum button count");
DECL_STATIC_STRING(buttons_retransmit, "Invalid buttons retransmit count");
DECL_STATIC_STRING(invalid_input_pin, "Not a valid input pin");

DECL_RESPONSE(buttons_state, "buttons_state oid=%c ack_count=%c state=%*s");

enum { BUTTONS_MAX = 8, EVENTS_MAX = 8, NO_PIN = 0xFF };

struct buttons {
    struct timer timer;
    uint32_t rest_ticks;
    uint8_t pins[BUTTONS_MAX];
    uint8_t count, invert;
    uint8_t last_sample, stable; // stable: the state last taken as an event
    uint8_t events[EVENTS_MAX], event_count;
    uint8_t acked; // events acknowledged so far, modulo 256
    uint8_t retransmit_count, retransmit_left, must_report;
};

static const struct oid_type buttons_type = {"buttons"};

static void demand_report(struct node *node, struct buttons *buttons) {
    buttons->must_report = 1;
    buttons->retransmit_left = buttons->retransmit_count;
    node_wake_tasks(node);
}

static uint8_t sample(struct node *node, const struct buttons *buttons) {
    uint8_t state = 0;
    for (unsigned i = 0; i < buttons->count; i++)
        if (buttons->pins[i] != NO_PIN && board_gpio_read(node, buttons->pins[i]))
            state |= (uint8_t)(1u << i);
    return state ^ buttons->invert;
}

static enum timer_result sample_event(struct node *node, struct timer *timer) {
    struct buttons *buttons = (struct buttons *)timer;
    uint8_t state = sample(node, buttons);
    int settled = state == buttons->last_sample;
    buttons->last_sample = state;
    // With the event buffer full the change waits, unless it reverts before the host makes room.
    if (settled && state != buttons->stable && buttons->event_count < EVENTS_MAX) {
        buttons->stable = state;
        buttons->events[buttons->event_count++] = state;
        demand_report(node, buttons);
    } else if (buttons->event_count && --buttons->retransmit_left == 0) {
        demand_report(node, buttons);
    }
    timer->waketime += buttons->rest_ticks;
    return TIMER_AGAIN;
}

void command_config_buttons(struct node *node, const struct wire_arg *args) {
    if (args[1].value > BUTTONS_MAX) {
        node_shutdown(node, STRING(buttons_max));
        return;
    }
    struct buttons *buttons = oid_create(node, args[0].value, &buttons_type, sizeof(*buttons));
    if (!buttons)
        return;
    buttons->count = (uint8_t)args[1].value;
    memset(buttons->pins, NO_PIN, sizeof(buttons->pins));
    buttons->timer.function = sample_event;
}
DECL_COMMAND(command_config_buttons, "config_buttons oid=%c button_count=%c", 0);

void command_buttons_add(struct node *node, const struct wire_arg *args) {
    struct buttons *buttons = oid_find(node, args[0].value, &buttons_type);
    if (!buttons)
        return;
    if (args[1].value >= buttons->count)
        node_shutdown(node, STRING(buttons_position));
    else if (args[2].value >= NO_PIN || board_gpio_in(node, args[2].value, (int8_t)args[3].value))
        node_shutdown(node, STRING(invalid_input_pin));
    else
        buttons->pins[args[1].value] = (uint8_t)args[2].value;
}
DECL_COMMAND(command_buttons_add, "buttons_add oid=%c pos=%c pin=%u pull_up=%c", 0);

void command_buttons_query(struct node *node, const struct wire_arg *args) {
    struct buttons *buttons = oid_find(node, args[0].value, &buttons_type);
    if (!buttons)
        return;
    uint32_t irq = board_irq_save(node);
    sched_delete_timer(node, &buttons->timer);
    buttons->timer.waketime = args[1].value;
    buttons->rest_ticks = args[2].value;
    buttons->retransmit_count = (uint8_t)args[3].value;
    buttons->invert = (uint8_t)args[4].value;
    buttons->last_sample = buttons->stable = 0;
    buttons->event_count = buttons->acked = buttons->must_report = 0;
    if (!buttons->retransmit_count)
        node_shutdown(node, STRING(buttons_retransmit));
    else if (buttons->rest_ticks)
        sched_add_timer(node, &buttons->timer);
    board_irq_restore(node, irq);
}
DECL_COMMAND(command_buttons_query,
             "buttons_query oid=%c clock=%u rest_ticks=%u retransmit_count=%c invert=%c", 0);

void command_buttons_ack(struct node *node, const struct wire_arg *args) {
    struct buttons *buttons = oid_find(node, args[0].value, &buttons_type);
    if (!buttons)
        return;
    uint32_t irq = board_irq_save(node);
    uint8_t count = (uint8_t)args[1].value;
    if (count > buttons->event_count)
        count = buttons->event_count;
    buttons->acked = (uint8_t)(buttons->acked + count);
    buttons->event_count = (uint8_t)(buttons->event_count - count);
    memmove(buttons->events, buttons->events + count, buttons->event_count);
    board_irq_restore(node, irq);
}
DECL_COMMAND(command_buttons_ack, "buttons_ack oid=%c count=%c", 0);

void buttons_task(struct node *node) {
    struct buttons *buttons;
    for (unsigned oid = 0; (buttons = oid_next(node, &oid, &buttons_type));) {
        if (!buttons->must_report || !node_can_respond(node))
            continue;
        uint8_t events[EVENTS_MAX];
        uint32_t irq = board_irq_save(node);
        uint8_t count = buttons->event_count, acked = buttons->acked;
        memcpy(events, buttons->events, sizeof(events));
        buttons->must_report = 0;
        board_irq_restore(node, irq);
        if (count)
            RESPOND(node, buttons_state, INT(oid - 1), INT(acked), BYTES(events, count));
    }
}
DECL_TASK(buttons_task);

void buttons_shutdown(struct node *node) {
    struct buttons *buttons;
    for (unsigned oid = 0; (buttons = oid_next(node, &oid, &buttons_type));) {
        sched_delete_timer(node, &buttons->timer);
        buttons->must_report = 0;
    }
}
DECL_SHUTDOWN_HOOK(buttons_shutdown);
