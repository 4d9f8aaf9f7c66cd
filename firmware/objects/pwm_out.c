// SPDX-License-Identifier: Apache-2.0
// Hardware PWM outputs.
#include "boards/board.h"
#include "objects/timed_output.h"

DECL_STATIC_STRING(missed_pwm, "Missed scheduling of next hard pwm event");
DECL_STATIC_STRING(exceeds_pwm, "Scheduled pwm event will exceed max_duration");
DECL_STATIC_STRING(invalid_pwm_pin, "Not a valid PWM pin");

struct pwm_out {
    struct timed_output output;
    uint32_t pin;
};

static const struct oid_type pwm_out_type = {"pwm_out"};

static void apply(struct node *node, struct timed_output *output, uint32_t clock, uint32_t value) {
    (void)clock;
    board_pwm_write(node, ((struct pwm_out *)output)->pin, (uint16_t)value);
}

void command_config_pwm_out(struct node *node, const struct wire_arg *args) {
    if (board_pwm_setup(node, args[1].value, args[2].value, (uint16_t)args[3].value)) {
        node_shutdown(node, STRING(invalid_pwm_pin));
        return;
    }
    struct pwm_out *out = oid_create(node, args[0].value, &pwm_out_type, sizeof(*out));
    if (!out)
        return;
    out->pin = args[1].value;
    out->output.apply = apply;
    out->output.default_value = args[4].value;
    out->output.max_duration = args[5].value;
    out->output.missed = STRING(missed_pwm);
    out->output.exceeded = STRING(exceeds_pwm);
    timed_output_init(&out->output);
    uint32_t irq = board_irq_save(node);
    timed_output_update(node, &out->output, args[3].value);
    board_irq_restore(node, irq);
}
DECL_COMMAND(command_config_pwm_out,
             "config_pwm_out oid=%c pin=%u cycle_ticks=%u value=%hu default_value=%hu max_duration=%u", 0);

void command_queue_pwm_out(struct node *node, const struct wire_arg *args) {
    struct pwm_out *out = oid_find(node, args[0].value, &pwm_out_type);
    if (!out)
        return;
    uint32_t irq = board_irq_save(node);
    timed_output_queue(node, &out->output, args[1].value, args[2].value);
    board_irq_restore(node, irq);
}
DECL_COMMAND(command_queue_pwm_out, "queue_pwm_out oid=%c clock=%u value=%hu", 0);

void pwm_out_shutdown(struct node *node) {
    struct pwm_out *out;
    for (unsigned oid = 0; (out = oid_next(node, &oid, &pwm_out_type));)
        timed_output_stop(node, &out->output);
}
DECL_SHUTDOWN_HOOK(pwm_out_shutdown);
