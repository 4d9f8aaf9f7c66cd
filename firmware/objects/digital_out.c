// SPDX-License-Identifier: Apache-2.0
// Digital outputs, on request with PWM in software: queued values are then ticks of a cycle.
#include "boards/board.h"
#include "objects/timed_output.h"

DECL_STATIC_STRING(missed_digital, "Missed scheduling of next digital out event");
DECL_STATIC_STRING(exceeds_digital, "Scheduled digital out event will exceed max_duration");
DECL_STATIC_STRING(cycle_pending, "Can not set soft pwm cycle ticks while updates pending");
DECL_STATIC_STRING(update_queued, "update_digital_out not valid with active queue");
DECL_STATIC_STRING(invalid_output_pin, "Not an output pin");

// Values are on_ticks: 0 is off, cycle_ticks or more is on. Without a cycle any value but 0 is on.
struct digital_out {
    struct timed_output output;
    struct timer toggle_timer;
    uint32_t pin;
    uint32_t cycle_ticks, on_ticks; // software PWM runs while 0 < on_ticks < cycle_ticks
    uint8_t level;
};

static const struct oid_type digital_out_type = {"digital_out"};

static struct digital_out *find(struct node *node, uint32_t oid) {
    return oid_find(node, oid, &digital_out_type);
}

static enum timer_result toggle_event(struct node *node, struct timer *timer) {
    struct digital_out *out =
        (struct digital_out *)((char *)timer - offsetof(struct digital_out, toggle_timer));
    out->level ^= 1;
    board_gpio_write(node, out->pin, out->level);
    timer->waketime += out->level ? out->on_ticks : out->cycle_ticks - out->on_ticks;
    return TIMER_AGAIN;
}

static void apply(struct node *node, struct timed_output *output, uint32_t clock, uint32_t value) {
    struct digital_out *out = (struct digital_out *)output;
    sched_delete_timer(node, &out->toggle_timer);
    out->level = value != 0;
    board_gpio_write(node, out->pin, out->level);
    if (!value || value >= out->cycle_ticks)
        return;
    out->on_ticks = value;
    out->toggle_timer.waketime = clock + value;
    sched_add_timer(node, &out->toggle_timer);
}

void command_config_digital_out(struct node *node, const struct wire_arg *args) {
    // The pin first: what exists as an object is driven by the shutdown hook.
    if (board_gpio_out(node, args[1].value, args[2].value != 0)) {
        node_shutdown(node, STRING(invalid_output_pin));
        return;
    }
    struct digital_out *out = oid_create(node, args[0].value, &digital_out_type, sizeof(*out));
    if (!out)
        return;
    out->pin = args[1].value;
    out->output.apply = apply;
    out->output.default_value = args[3].value != 0;
    out->output.max_duration = args[4].value;
    out->output.missed = STRING(missed_digital);
    out->output.exceeded = STRING(exceeds_digital);
    out->toggle_timer.function = toggle_event;
    timed_output_init(&out->output);
    uint32_t irq = board_irq_save(node);
    timed_output_update(node, &out->output, args[2].value != 0);
    board_irq_restore(node, irq);
}
DECL_COMMAND(command_config_digital_out,
             "config_digital_out oid=%c pin=%u value=%c default_value=%c max_duration=%u", 0);

// Brings ON_TICKS to one value for "on", so that it compares with the default.
static uint32_t normal(const struct digital_out *out, uint32_t on_ticks) {
    uint32_t full = out->cycle_ticks ? out->cycle_ticks : 1;
    return on_ticks < full ? on_ticks : full;
}

void command_set_digital_out_pwm_cycle(struct node *node, const struct wire_arg *args) {
    struct digital_out *out = find(node, args[0].value);
    if (!out)
        return;
    uint32_t irq = board_irq_save(node);
    if (out->output.queue.first) {
        node_shutdown(node, STRING(cycle_pending));
    } else {
        // "On" is a whole cycle from now on; what the pin does stays as it is until the next value.
        out->cycle_ticks = args[1].value;
        out->output.default_value = out->output.default_value ? normal(out, UINT32_MAX) : 0;
    }
    board_irq_restore(node, irq);
}
DECL_COMMAND(command_set_digital_out_pwm_cycle, "set_digital_out_pwm_cycle oid=%c cycle_ticks=%u", 0);

void command_queue_digital_out(struct node *node, const struct wire_arg *args) {
    struct digital_out *out = find(node, args[0].value);
    if (!out)
        return;
    uint32_t irq = board_irq_save(node);
    timed_output_queue(node, &out->output, args[1].value, normal(out, args[2].value));
    board_irq_restore(node, irq);
}
DECL_COMMAND(command_queue_digital_out, "queue_digital_out oid=%c clock=%u on_ticks=%u", 0);

void command_update_digital_out(struct node *node, const struct wire_arg *args) {
    struct digital_out *out = find(node, args[0].value);
    if (!out)
        return;
    uint32_t irq = board_irq_save(node);
    if (out->output.queue.first)
        node_shutdown(node, STRING(update_queued));
    else
        timed_output_update(node, &out->output, args[1].value ? normal(out, UINT32_MAX) : 0);
    board_irq_restore(node, irq);
}
DECL_COMMAND(command_update_digital_out, "update_digital_out oid=%c value=%c", 0);

void command_set_digital_out(struct node *node, const struct wire_arg *args) {
    if (board_gpio_out(node, args[0].value, args[1].value != 0))
        node_shutdown(node, STRING(invalid_output_pin));
}
DECL_COMMAND(command_set_digital_out, "set_digital_out pin=%u value=%c", 0);

void digital_out_shutdown(struct node *node) {
    struct digital_out *out;
    for (unsigned oid = 0; (out = oid_next(node, &oid, &digital_out_type));)
        timed_output_stop(node, &out->output);
}
DECL_SHUTDOWN_HOOK(digital_out_shutdown);
