// SPDX-License-Identifier: Apache-2.0
// Counters (tachometers): a pin is looked at every poll_ticks from CLOCK on and its changes are counted, both
// edges. Every sample_ticks the count is reported with the clock of its last change, so that a frequency
// comes out exact to a poll over however many reports.
#include "boards/board.h"

DECL_STATIC_STRING(invalid_input_pin, "Not a valid input pin");

DECL_RESPONSE(counter_state, "counter_state oid=%c next_clock=%u count=%u count_clock=%u");

struct counter {
    struct timer timer;
    uint32_t pin, poll_ticks, sample_ticks;
    uint32_t sample_clock; // of the next report
    uint32_t count, count_clock;
    uint8_t level;
    // The finished report, while the task has not sent it.
    uint8_t ready;
    uint32_t report_clock, report_count, report_count_clock;
};

static const struct oid_type counter_type = {"counter"};

static enum timer_result poll_event(struct node *node, struct timer *timer) {
    struct counter *counter = (struct counter *)timer;
    uint32_t now = timer->waketime;
    uint8_t level = board_gpio_read(node, counter->pin) != 0;
    if (level != counter->level) {
        counter->level = level;
        counter->count++;
        counter->count_clock = now;
    }
    if (!clock_before(now, counter->sample_clock)) {
        counter->sample_clock += counter->sample_ticks;
        counter->report_clock = counter->sample_clock;
        counter->report_count = counter->count;
        counter->report_count_clock = counter->count_clock;
        counter->ready = 1;
        node_wake_tasks(node);
    }
    timer->waketime += counter->poll_ticks;
    return TIMER_AGAIN;
}

void command_config_counter(struct node *node, const struct wire_arg *args) {
    if (board_gpio_in(node, args[1].value, (int8_t)args[2].value)) {
        node_shutdown(node, STRING(invalid_input_pin));
        return;
    }
    struct counter *counter = oid_create(node, args[0].value, &counter_type, sizeof(*counter));
    if (!counter)
        return;
    counter->pin = args[1].value;
    counter->timer.function = poll_event;
}
DECL_COMMAND(command_config_counter, "config_counter oid=%c pin=%u pull_up=%c", 0);

void command_query_counter(struct node *node, const struct wire_arg *args) {
    struct counter *counter = oid_find(node, args[0].value, &counter_type);
    if (!counter)
        return;
    uint32_t irq = board_irq_save(node);
    sched_delete_timer(node, &counter->timer);
    counter->timer.waketime = counter->sample_clock = counter->count_clock = args[1].value;
    counter->poll_ticks = args[2].value;
    counter->sample_ticks = args[3].value;
    counter->level = board_gpio_read(node, counter->pin) != 0;
    counter->count = counter->ready = 0;
    if (counter->poll_ticks) // else it ends here
        sched_add_timer(node, &counter->timer);
    board_irq_restore(node, irq);
}
DECL_COMMAND(command_query_counter, "query_counter oid=%c clock=%u poll_ticks=%u sample_ticks=%u", 0);

void counter_task(struct node *node) {
    struct counter *counter;
    for (unsigned oid = 0; (counter = oid_next(node, &oid, &counter_type));) {
        if (!counter->ready || !node_can_respond(node))
            continue;
        uint32_t irq = board_irq_save(node);
        uint32_t next = counter->report_clock, count = counter->report_count;
        uint32_t count_clock = counter->report_count_clock;
        counter->ready = 0;
        board_irq_restore(node, irq);
        RESPOND(node, counter_state, INT(oid - 1), INT(next), INT(count), INT(count_clock));
    }
}
DECL_TASK(counter_task);

void counter_shutdown(struct node *node) {
    struct counter *counter;
    for (unsigned oid = 0; (counter = oid_next(node, &oid, &counter_type));) {
        sched_delete_timer(node, &counter->timer);
        counter->ready = 0;
    }
}
DECL_SHUTDOWN_HOOK(counter_shutdown);
