// SPDX-License-Identifier: Apache-2.0
// Buttons: up to eight pins polled together; each new state is reported until the host acknowledges it.
#include "boards/board.h"
#include "core/node.h"

enum { BUTTONS_MAX = 8, REPORTS_MAX = 8 };

struct buttons {
    struct timer timer; // first: the timer leads back to the object
    struct board_pin pins[BUTTONS_MAX];
    uint32_t rest_ticks;
    uint8_t count, added; // added: one bit for each pin set up
    uint8_t invert;
    uint8_t reported; // the last state queued
    uint8_t sampled;  // the last state read; a state counts when it is read twice in a row
    uint8_t reports[REPORTS_MAX], report_count;
    uint8_t ack_count; // reports acknowledged so far: the host knows which of those it gets are new
    uint8_t retransmit_count, polls_unanswered;
    bool report_due;
};

static const struct oid_type buttons_type = {"buttons"};
DECL_STATIC_STRING(not_a_pin, "Not a valid pin");
DECL_STATIC_STRING(buttons_max, "Max of 8 buttons");
DECL_STATIC_STRING(buttons_past_max, "Set button past maximum button count");
DECL_STATIC_STRING(buttons_retransmit, "Invalid buttons retransmit count");
DECL_RESPONSE(buttons_state, "buttons_state oid=%c ack_count=%c state=%*s");

DECL_TASK(buttons_task);
void buttons_task(struct node *node) {
    uint16_t oid = 0;
    struct buttons *b;
    while ((b = oid_next(node, &buttons_type, &oid))) {
        uint8_t reports[REPORTS_MAX];
        uint32_t irq = board_irq_save(node);
        bool due = b->report_due;
        uint8_t count = b->report_count, ack_count = b->ack_count;
        for (uint8_t i = 0; i < count; i++)
            reports[i] = b->reports[i];
        b->report_due = false;
        board_irq_restore(node, irq);
        if (due)
            RESPOND(node, buttons_state, ARG(oid - 1), ARG(ack_count), ARG_BYTES(reports, count));
    }
}

static void report(struct node *node, struct buttons *b) {
    b->report_due = true;
    b->polls_unanswered = 0;
    WAKE(node, buttons_task);
}

static uint8_t read_pins(struct node *node, const struct buttons *b) {
    uint8_t state = 0;
    for (uint8_t i = 0; i < b->count; i++)
        if (b->added & (1U << i) && board_gpio_read(node, b->pins[i]))
            state |= (uint8_t)(1U << i);
    return state ^ b->invert;
}

static enum timer_result buttons_run(struct node *node, struct timer *timer) {
    struct buttons *b = (struct buttons *)(void *)timer;
    uint8_t state = read_pins(node, b);
    bool steady = state == b->sampled;
    b->sampled = state;
    // With a full queue a change is not lost: it is seen again, as it stands then, at the next poll.
    if (steady && state != b->reported && b->report_count < REPORTS_MAX) {
        b->reports[b->report_count++] = b->reported = state;
        report(node, b);
    } else if (b->report_count && ++b->polls_unanswered >= b->retransmit_count) {
        report(node, b);
    }
    timer->wake_clock += b->rest_ticks;
    return TIMER_RESCHEDULE;
}

DECL_COMMAND(command_config_buttons, "config_buttons oid=%c button_count=%c");
void command_config_buttons(struct node *node, const struct wire_arg *args) {
    if (args[1].value > BUTTONS_MAX) {
        node_shutdown(node, string_buttons_max);
        return;
    }
    struct buttons *b = oid_alloc(node, (uint8_t)args[0].value, &buttons_type, sizeof(*b));
    if (!b)
        return;
    b->count = (uint8_t)args[1].value;
    b->timer.run = buttons_run;
}

DECL_COMMAND(command_buttons_add, "buttons_add oid=%c pos=%c pin=%u pull_up=%c");
void command_buttons_add(struct node *node, const struct wire_arg *args) {
    struct buttons *b = oid_lookup(node, (uint8_t)args[0].value, &buttons_type);
    uint32_t at = args[1].value;
    if (!b)
        return;
    if (at >= b->count) {
        node_shutdown(node, string_buttons_past_max);
        return;
    }
    if (board_gpio_in_setup(node, args[2].value, (int8_t)args[3].value, &b->pins[at])) {
        node_shutdown(node, string_not_a_pin);
        return;
    }
    b->added |= (uint8_t)(1U << at);
}

DECL_COMMAND(command_buttons_query,
             "buttons_query oid=%c clock=%u rest_ticks=%u retransmit_count=%c invert=%c");
void command_buttons_query(struct node *node, const struct wire_arg *args) {
    struct buttons *b = oid_lookup(node, (uint8_t)args[0].value, &buttons_type);
    if (!b)
        return;
    sched_del_timer(node, &b->timer);
    b->report_count = b->ack_count = b->polls_unanswered = b->reported = b->sampled = 0;
    b->report_due = false;
    b->rest_ticks = args[2].value;
    b->retransmit_count = (uint8_t)args[3].value;
    b->invert = (uint8_t)args[4].value;
    if (b->rest_ticks == 0)
        return;
    if (b->retransmit_count == 0) {
        node_shutdown(node, string_buttons_retransmit);
        return;
    }
    b->timer.wake_clock = args[1].value;
    sched_add_timer(node, &b->timer);
}

DECL_COMMAND(command_buttons_ack, "buttons_ack oid=%c count=%c");
void command_buttons_ack(struct node *node, const struct wire_arg *args) {
    struct buttons *b = oid_lookup(node, (uint8_t)args[0].value, &buttons_type);
    if (!b)
        return;
    uint32_t irq = board_irq_save(node);
    uint8_t count = (uint8_t)args[1].value;
    if (count > b->report_count)
        count = b->report_count;
    b->ack_count = (uint8_t)(b->ack_count + count);
    b->report_count = (uint8_t)(b->report_count - count);
    for (uint8_t i = 0; i < b->report_count; i++)
        b->reports[i] = b->reports[i + count];
    b->polls_unanswered = 0;
    board_irq_restore(node, irq);
}
