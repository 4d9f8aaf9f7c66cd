// SPDX-License-Identifier: Apache-2.0
// Analog inputs: sums of a few samples, checked against a range on the spot, reported in batches.
#include "boards/board.h"
#include "core/node.h"

enum { REPORT_MAX = 48, VALUE_BYTES = 2 };

struct analog_in {
    struct timer timer; // first: the timer leads back to the object
    struct board_pin pin;
    uint32_t sample_ticks, rest_ticks;
    uint32_t begin_clock; // of the first sample of the next sum
    uint32_t report_clock;
    uint32_t sum;
    uint16_t min_value, max_value;
    uint8_t sample_count, samples_left, range_check_count, out_of_range;
    uint8_t bytes_per_report, collected, report_size;
    uint8_t values[REPORT_MAX], report[REPORT_MAX];
};

static const struct oid_type analog_in_type = {"analog_in"};
DECL_STATIC_STRING(not_an_adc_pin, "Not a valid ADC pin");
DECL_STATIC_STRING(adc_out_of_range, "ADC out of range");
DECL_STATIC_STRING(adc_report_size, "Invalid analog_in bytes_per_report");
DECL_RESPONSE(analog_in_state, "analog_in_state oid=%c next_clock=%u values=%*s");

DECL_TASK(analog_in_task);
void analog_in_task(struct node *node) {
    uint16_t oid = 0;
    struct analog_in *a;
    while ((a = oid_next(node, &analog_in_type, &oid))) {
        uint8_t report[REPORT_MAX];
        uint32_t irq = board_irq_save(node);
        uint8_t size = a->report_size;
        uint32_t next_clock = a->report_clock;
        for (uint8_t i = 0; i < size; i++)
            report[i] = a->report[i];
        a->report_size = 0;
        board_irq_restore(node, irq);
        if (size)
            RESPOND(node, analog_in_state, ARG(oid - 1), ARG(next_clock), ARG_BYTES(report, size));
    }
}

// Puts a sum into the batch. A batch whose forerunner was not sent yet replaces it.
static void collect(struct node *node, struct analog_in *a, uint16_t value) {
    a->values[a->collected++] = (uint8_t)value;
    a->values[a->collected++] = (uint8_t)(value >> 8);
    if (a->collected < a->bytes_per_report)
        return;
    for (uint8_t i = 0; i < a->collected; i++)
        a->report[i] = a->values[i];
    a->report_size = a->collected;
    a->report_clock = a->begin_clock;
    a->collected = 0;
    WAKE(node, analog_in_task);
}

static bool range_is_violated(struct analog_in *a, uint32_t sum) {
    if (sum >= a->min_value && sum <= a->max_value) {
        a->out_of_range = 0;
        return false;
    }
    a->out_of_range++;
    return a->range_check_count && a->out_of_range >= a->range_check_count;
}

static enum timer_result analog_in_run(struct node *node, struct timer *timer) {
    struct analog_in *a = (struct analog_in *)(void *)timer;
    a->sum += board_adc_read(node, a->pin);
    if (--a->samples_left) {
        timer->wake_clock += a->sample_ticks;
        return TIMER_RESCHEDULE;
    }
    uint32_t sum = a->sum;
    a->sum = 0;
    a->samples_left = a->sample_count;
    a->begin_clock += a->rest_ticks;
    if (range_is_violated(a, sum)) {
        node_shutdown(node, string_adc_out_of_range);
        return TIMER_DONE;
    }
    collect(node, a, sum < UINT16_MAX ? (uint16_t)sum : UINT16_MAX);
    timer->wake_clock = a->begin_clock;
    return TIMER_RESCHEDULE;
}

DECL_COMMAND(command_config_analog_in, "config_analog_in oid=%c pin=%u");
void command_config_analog_in(struct node *node, const struct wire_arg *args) {
    struct analog_in *a = oid_alloc(node, (uint8_t)args[0].value, &analog_in_type, sizeof(*a));
    if (!a)
        return;
    a->timer.run = analog_in_run;
    if (board_adc_setup(node, args[1].value, &a->pin))
        node_shutdown(node, string_not_an_adc_pin);
}

DECL_COMMAND(
    command_query_analog_in,
    "query_analog_in oid=%c clock=%u sample_ticks=%u sample_count=%c rest_ticks=%u bytes_per_report=%c"
    " min_value=%hu max_value=%hu range_check_count=%c");
void command_query_analog_in(struct node *node, const struct wire_arg *args) {
    struct analog_in *a = oid_lookup(node, (uint8_t)args[0].value, &analog_in_type);
    if (!a)
        return;
    sched_del_timer(node, &a->timer);
    a->sample_count = a->samples_left = (uint8_t)args[3].value;
    if (a->sample_count == 0)
        return;
    a->bytes_per_report = (uint8_t)args[5].value;
    if (a->bytes_per_report == 0 || a->bytes_per_report % VALUE_BYTES || a->bytes_per_report > REPORT_MAX) {
        node_shutdown(node, string_adc_report_size);
        return;
    }
    a->timer.wake_clock = a->begin_clock = args[1].value;
    a->sample_ticks = args[2].value;
    a->rest_ticks = args[4].value;
    a->min_value = (uint16_t)args[6].value;
    a->max_value = (uint16_t)args[7].value;
    a->range_check_count = (uint8_t)args[8].value;
    a->sum = 0;
    a->out_of_range = a->collected = a->report_size = 0;
    sched_add_timer(node, &a->timer);
}
