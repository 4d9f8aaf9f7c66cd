// SPDX-License-Identifier: Apache-2.0
// Analog inputs: from CLOCK on, every rest_ticks, the sum of sample_count samples taken sample_ticks apart.
// Sums are gathered, two bytes each, until bytes_per_report are there. Too many sums in a row out of range:
// shutdown.
#include "boards/board.h"

#include <string.h>

DECL_STATIC_STRING(adc_range, "ADC out of range");
DECL_STATIC_STRING(adc_pin, "Not a valid ADC pin");
DECL_STATIC_STRING(adc_report, "Invalid analog_in bytes_per_report");

DECL_RESPONSE(analog_in_state, "analog_in_state oid=%c next_clock=%u values=%*s");

enum { REPORT_MAX = 48, VALUE_SIZE = 2 };

struct analog_in {
    struct timer timer;
    uint32_t pin, sample_ticks, rest_ticks, next_begin;
    uint16_t sum, min, max;
    uint8_t sample_count, samples_taken; // sample_count 0: not sampling
    uint8_t range_check_count, out_of_range;
    uint8_t report_size, size;
    uint8_t values[REPORT_MAX];
    // The finished report, while the task has not sent it.
    uint8_t report[REPORT_MAX], ready;
    uint32_t report_clock;
};

static const struct oid_type analog_in_type = {"analog_in"};

static void finish_sum(struct node *node, struct analog_in *in) {
    int outside = in->sum < in->min || in->sum > in->max;
    in->out_of_range = outside ? (uint8_t)(in->out_of_range + 1) : 0;
    if (outside && in->out_of_range >= in->range_check_count) {
        node_shutdown(node, STRING(adc_range));
        return;
    }
    in->values[in->size++] = (uint8_t)in->sum;
    in->values[in->size++] = (uint8_t)(in->sum >> 8);
    if (in->size < in->report_size)
        return;
    memcpy(in->report, in->values, in->size);
    in->size = 0;
    in->report_clock = in->next_begin;
    in->ready = 1;
    node_wake_tasks(node);
}

static enum timer_result sample_event(struct node *node, struct timer *timer) {
    struct analog_in *in = (struct analog_in *)timer;
    uint16_t value;
    uint32_t delay = board_adc_sample(node, in->pin, &value);
    if (delay) {
        timer->waketime += delay;
        return TIMER_AGAIN;
    }
    if (in->samples_taken == 0) {
        in->next_begin += in->rest_ticks;
        in->sum = 0;
    }
    in->sum = (uint16_t)(in->sum + value);
    if (++in->samples_taken < in->sample_count) {
        timer->waketime += in->sample_ticks;
        return TIMER_AGAIN;
    }
    in->samples_taken = 0;
    finish_sum(node, in);
    timer->waketime = in->next_begin;
    return TIMER_AGAIN;
}

void command_config_analog_in(struct node *node, const struct wire_arg *args) {
    if (board_adc_setup(node, args[1].value)) {
        node_shutdown(node, STRING(adc_pin));
        return;
    }
    struct analog_in *in = oid_create(node, args[0].value, &analog_in_type, sizeof(*in));
    if (!in)
        return;
    in->pin = args[1].value;
    in->timer.function = sample_event;
}
DECL_COMMAND(command_config_analog_in, "config_analog_in oid=%c pin=%u", 0);

void command_query_analog_in(struct node *node, const struct wire_arg *args) {
    struct analog_in *in = oid_find(node, args[0].value, &analog_in_type);
    if (!in)
        return;
    uint32_t report_size = args[5].value;
    if (report_size < VALUE_SIZE || report_size > REPORT_MAX || report_size % VALUE_SIZE) {
        node_shutdown(node, STRING(adc_report));
        return;
    }
    uint32_t irq = board_irq_save(node);
    sched_delete_timer(node, &in->timer);
    in->timer.waketime = in->next_begin = args[1].value;
    in->sample_ticks = args[2].value;
    in->sample_count = (uint8_t)args[3].value;
    in->rest_ticks = args[4].value;
    in->report_size = (uint8_t)report_size;
    in->min = (uint16_t)args[6].value;
    in->max = (uint16_t)args[7].value;
    in->range_check_count = (uint8_t)args[8].value;
    in->samples_taken = in->out_of_range = in->size = in->ready = 0;
    if (in->sample_count)
        sched_add_timer(node, &in->timer);
    board_irq_restore(node, irq);
}
DECL_COMMAND(
    command_query_analog_in,
    "query_analog_in oid=%c clock=%u sample_ticks=%u sample_count=%c rest_ticks=%u bytes_per_report=%c "
    "min_value=%hu max_value=%hu range_check_count=%c",
    0);

void analog_in_task(struct node *node) {
    struct analog_in *in;
    for (unsigned oid = 0; (in = oid_next(node, &oid, &analog_in_type));) {
        if (!in->ready || !node_can_respond(node))
            continue;
        uint8_t report[REPORT_MAX];
        uint32_t irq = board_irq_save(node);
        uint32_t clock = in->report_clock;
        memcpy(report, in->report, sizeof(report));
        in->ready = 0;
        board_irq_restore(node, irq);
        RESPOND(node, analog_in_state, INT(oid - 1), INT(clock), BYTES(report, in->report_size));
    }
}
DECL_TASK(analog_in_task);

void analog_in_shutdown(struct node *node) {
    struct analog_in *in;
    for (unsigned oid = 0; (in = oid_next(node, &oid, &analog_in_type));) {
        sched_delete_timer(node, &in->timer);
        in->ready = 0;
    }
}
DECL_SHUTDOWN_HOOK(analog_in_shutdown);
