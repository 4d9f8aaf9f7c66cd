// SPDX-License-Identifier: Apache-2.0
// Digital outputs, with software PWM.
#include "boards/board.h"
#include "objects/timed_output.h"

struct digital_out {
    struct timed_output output; // first: outputs lead back to the object
    struct board_pin pin;
    uint32_t cycle_ticks; // 0: no PWM, any on_ticks but 0 is on
    uint32_t on_ticks;    // of the cycle under way
    bool level, default_level;
};

static const struct oid_type digital_out_type = {"digital_out"};
DECL_STATIC_STRING(not_a_pin, "Not a valid pin");
DECL_STATIC_STRING(digital_missed, "Missed scheduling of next digital out event");
DECL_STATIC_STRING(digital_exceeds, "Scheduled digital out event will exceed max_duration");
DECL_STATIC_STRING(update_queued, "update_digital_out not valid with active queue");
DECL_STATIC_STRING(cycle_queued, "Can not set soft pwm cycle ticks while updates pending");

static void set_level(struct node *node, struct digital_out *d, bool level) {
    d->level = level;
    board_gpio_write(node, d->pin, level);
}

static bool digital_apply(struct node *node, struct timed_output *output, uint32_t value, uint32_t clock) {
    struct digital_out *d = (struct digital_out *)output;
    set_level(node, d, value != 0);
    bool pulses = d->cycle_ticks && value && value < d->cycle_ticks;
    d->on_ticks = value;
    output->has_between = pulses;
    output->between_clock = clock + value;
    return !pulses && d->level == d->default_level;
}

static void digital_between(struct node *node, struct timed_output *output, uint32_t clock) {
    struct digital_out *d = (struct digital_out *)output;
    set_level(node, d, !d->level);
    output->between_clock = clock + (d->level ? d->on_ticks : d->cycle_ticks - d->on_ticks);
}

static const struct timed_output_kind digital_kind = {digital_apply, digital_between, &string_digital_missed,
                                                      &string_digital_exceeds};

static struct digital_out *lookup(struct node *node, uint32_t oid) {
    return oid_lookup(node, (uint8_t)oid, &digital_out_type);
}

DECL_COMMAND(command_config_digital_out,
             "config_digital_out oid=%c pin=%u value=%c default_value=%c max_duration=%u");
void command_config_digital_out(struct node *node, const struct wire_arg *args) {
    struct digital_out *d = oid_alloc(node, (uint8_t)args[0].value, &digital_out_type, sizeof(*d));
    if (!d)
        return;
    d->level = args[2].value != 0;
    d->default_level = args[3].value != 0;
    timed_output_setup(&d->output, &digital_kind, args[4].value);
    if (board_gpio_out_setup(node, args[1].value, d->level, &d->pin))
        node_shutdown(node, string_not_a_pin);
}

DECL_COMMAND(command_set_digital_out_pwm_cycle, "set_digital_out_pwm_cycle oid=%c cycle_ticks=%u");
void command_set_digital_out_pwm_cycle(struct node *node, const struct wire_arg *args) {
    struct digital_out *d = lookup(node, args[0].value);
    if (!d)
        return;
    uint32_t irq = board_irq_save(node);
    bool pending = d->output.queue.first || d->output.has_between;
    if (!pending)
        d->cycle_ticks = args[1].value;
    board_irq_restore(node, irq);
    if (pending)
        node_shutdown(node, string_cycle_queued);
}

DECL_COMMAND_FLAGS(command_queue_digital_out, COMMAND_FREQUENT,
                   "queue_digital_out oid=%c clock=%u on_ticks=%u");
void command_queue_digital_out(struct node *node, const struct wire_arg *args) {
    struct digital_out *d = lookup(node, args[0].value);
    if (d)
        timed_output_queue(node, &d->output, args[1].value, args[2].value);
}

DECL_COMMAND(command_update_digital_out, "update_digital_out oid=%c value=%c");
void command_update_digital_out(struct node *node, const struct wire_arg *args) {
    struct digital_out *d = lookup(node, args[0].value);
    if (!d)
        return;
    if (d->output.queue.first)
        node_shutdown(node, string_update_queued);
    else // with PWM, on means all of the cycle
        timed_output_set(node, &d->output, args[1].value ? UINT32_MAX : 0);
}

DECL_COMMAND(command_set_digital_out, "set_digital_out pin=%u value=%c");
void command_set_digital_out(struct node *node, const struct wire_arg *args) {
    struct board_pin pin;
    if (board_gpio_out_setup(node, args[0].value, args[1].value != 0, &pin))
        node_shutdown(node, string_not_a_pin);
}

DECL_SHUTDOWN_HOOK(digital_out_shutdown);
void digital_out_shutdown(struct node *node) {
    uint16_t oid = 0;
    struct digital_out *d;
    while ((d = oid_next(node, &digital_out_type, &oid))) {
        timed_output_stop(node, &d->output);
        set_level(node, d, d->default_level);
    }
}
