// SPDX-License-Identifier: Apache-2.0
// The converters HX711 and HX717 of load cells, on two pins: the chip lowers DOUT when it has a conversion,
// and gives its 24 bits by pulses of SCLK, the highest one first. As many more pulses as gain_channel says
// choose gain and channel of the next conversion; DOUT is high then until that is there.
//
// The pin is looked at every rest_ticks. SCLK must not be high for 60 us while it is read: the chip would go
// to sleep, which here is what resets one that has lost count.
#include "boards/board.h"
#include "objects/sensor_bulk.h"
#include "objects/trigger_analog.h"

DECL_STATIC_STRING(hx71x_rest, "Invalid hx71x rest_ticks");
DECL_STATIC_STRING(hx71x_gain, "Invalid hx71x gain_channel");
DECL_STATIC_STRING(invalid_input_pin, "Not a valid input pin");
DECL_STATIC_STRING(invalid_output_pin, "Not an output pin");

// What the chip adds to the errors of a trigger, and to HX71X_LOST in a reading.
DECL_ENUMERATION("hx71x_error:", "LOST_COUNT", 0);

enum { LOST_COUNT, BITS = 24, GAINS = 4, READING_SIZE = 4, PULSES_PER_S = 4000000, LOOKS_PER_PULSE = 64 };
static const uint32_t HX71X_LOST = 0x80000000u; // no reading of 24 bits

struct hx71x {
    struct timer timer;
    struct trigger_analog *trigger; // NULL: it has none
    struct sensor_bulk bulk;
    uint32_t dout_pin, sclk_pin, rest_ticks, look_clock;
    uint8_t gain_channel, must_read;
    uint8_t asleep; // SCLK is high since the last look
    uint8_t stale;  // the next conversion is one from before
};

static const struct oid_type hx71x_type = {"hx71x"};

static enum timer_result look_event(struct node *node, struct timer *timer) {
    struct hx71x *hx = (struct hx71x *)timer;
    if (hx->asleep) {
        board_gpio_write(node, hx->sclk_pin, 0);
        hx->asleep = 0;
    } else if (!hx->must_read && !board_gpio_read(node, hx->dout_pin)) {
        hx->must_read = 1;
        hx->look_clock = timer->waketime;
        node_wake_tasks(node);
    }
    timer->waketime += hx->rest_ticks;
    return TIMER_AGAIN;
}

// ------------------------------------------------------------------------------------------------ the chip

// A quarter of a microsecond; a clock that stands still meanwhile, as in a simulation, ends it as well.
static void wait(struct node *node) {
    uint32_t begin = board_clock(node), ticks = node->config.clock_freq / PULSES_PER_S;
    for (int i = 0; i < LOOKS_PER_PULSE && board_clock(node) - begin < ticks; i++)
        ;
}

static uint32_t pulse(struct node *node, const struct hx71x *hx) {
    uint32_t irq = board_irq_save(node);
    board_gpio_write(node, hx->sclk_pin, 1);
    wait(node);
    uint32_t bit = board_gpio_read(node, hx->dout_pin) != 0;
    board_gpio_write(node, hx->sclk_pin, 0);
    board_irq_restore(node, irq);
    wait(node);
    return bit;
}

static uint32_t take_reading(struct node *node, struct hx71x *hx) {
    uint32_t bits = 0;
    for (int i = 0; i < BITS; i++)
        bits = bits << 1 | pulse(node, hx);
    for (int i = 0; i < hx->gain_channel; i++)
        pulse(node, hx);
    if (!board_gpio_read(node, hx->dout_pin)) {
        board_gpio_write(node, hx->sclk_pin, 1);
        hx->asleep = hx->stale = 1;
        return HX71X_LOST + LOST_COUNT;
    }
    return (bits ^ 1u << (BITS - 1)) - (1u << (BITS - 1)); // its sign
}

static void read_chip(struct node *node, struct hx71x *hx, uint32_t oid) {
    uint32_t reading = take_reading(node, hx);
    hx->must_read = 0;
    int is_lost = reading == HX71X_LOST + LOST_COUNT;
    if (hx->stale && !is_lost) {
        hx->stale = 0;
        return;
    }
    if (hx->trigger && is_lost)
        trigger_analog_fail(node, hx->trigger, hx->look_clock, LOST_COUNT);
    else if (hx->trigger)
        trigger_analog_add(node, hx->trigger, hx->look_clock, (int32_t)reading);
    uint8_t bytes[READING_SIZE] = {(uint8_t)(reading >> 24), (uint8_t)(reading >> 16),
                                   (uint8_t)(reading >> 8), (uint8_t)reading};
    sensor_bulk_add(node, &hx->bulk, oid, bytes, READING_SIZE);
}

void hx71x_task(struct node *node) {
    struct hx71x *hx;
    for (unsigned oid = 0; (hx = oid_next(node, &oid, &hx71x_type));)
        if (hx->must_read)
            read_chip(node, hx, oid - 1);
}
DECL_TASK(hx71x_task);

// -------------------------------------------------------------------------------------------- commands

void command_config_hx71x(struct node *node, const struct wire_arg *args) {
    if (!args[1].value || args[1].value > GAINS) {
        node_shutdown(node, STRING(hx71x_gain));
        return;
    }
    if (board_gpio_in(node, args[2].value, 0)) {
        node_shutdown(node, STRING(invalid_input_pin));
        return;
    }
    if (board_gpio_out(node, args[3].value, 0)) {
        node_shutdown(node, STRING(invalid_output_pin));
        return;
    }
    struct hx71x *hx = oid_create(node, args[0].value, &hx71x_type, sizeof(*hx));
    if (!hx)
        return;
    hx->timer.function = look_event;
    hx->gain_channel = (uint8_t)args[1].value;
    hx->dout_pin = args[2].value;
    hx->sclk_pin = args[3].value;
}
DECL_COMMAND(command_config_hx71x, "config_hx71x oid=%c gain_channel=%c dout_pin=%u sclk_pin=%u", 0);

void command_hx71x_attach_trigger_analog(struct node *node, const struct wire_arg *args) {
    struct hx71x *hx = oid_find(node, args[0].value, &hx71x_type);
    struct trigger_analog *trigger = trigger_analog_find(node, args[1].value);
    if (hx && trigger)
        hx->trigger = trigger;
}
DECL_COMMAND(command_hx71x_attach_trigger_analog, "hx71x_attach_trigger_analog oid=%c trigger_analog_oid=%c",
             0);

// Begins to take readings, or with 0 ends it.
void command_query_hx71x(struct node *node, const struct wire_arg *args) {
    struct hx71x *hx = oid_find(node, args[0].value, &hx71x_type);
    if (!hx)
        return;
    if (args[1].value >= 1u << 31) {
        node_shutdown(node, STRING(hx71x_rest));
        return;
    }
    uint32_t irq = board_irq_save(node);
    sched_delete_timer(node, &hx->timer);
    hx->rest_ticks = args[1].value;
    hx->must_read = 0;
    if (hx->rest_ticks) {
        hx->stale = 1;
        sensor_bulk_reset(&hx->bulk);
        sched_add_timer_in(node, &hx->timer, hx->rest_ticks);
    }
    board_irq_restore(node, irq);
}
DECL_COMMAND(command_query_hx71x, "query_hx71x oid=%c rest_ticks=%u", 0);

void command_query_hx71x_status(struct node *node, const struct wire_arg *args) {
    const struct hx71x *hx = oid_find(node, args[0].value, &hx71x_type);
    if (!hx)
        return;
    uint32_t clock = board_clock(node);
    int waits = !hx->stale && (hx->must_read || !board_gpio_read(node, hx->dout_pin));
    sensor_bulk_status(node, &hx->bulk, args[0].value, clock, board_clock(node) - clock,
                       waits ? READING_SIZE : 0);
}
DECL_COMMAND(command_query_hx71x_status, "query_hx71x_status oid=%c", 0);

void hx71x_shutdown(struct node *node) {
    struct hx71x *hx;
    for (unsigned oid = 0; (hx = oid_next(node, &oid, &hx71x_type));) {
        sched_delete_timer(node, &hx->timer);
        hx->must_read = 0;
        hx->rest_ticks = 0;
    }
}
DECL_SHUTDOWN_HOOK(hx71x_shutdown);
