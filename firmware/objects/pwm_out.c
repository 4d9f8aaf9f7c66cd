// SPDX-License-Identifier: Apache-2.0
// Outputs with hardware PWM.
#include "boards/board.h"
#include "objects/timed_output.h"

struct pwm_out {
    struct timed_output output; // first: outputs lead back to the object
    struct board_pin pin;
    uint32_t default_value;
};

static const struct oid_type pwm_out_type = {"pwm_out"};
DECL_STATIC_STRING(not_a_pwm_pin, "Not a valid PWM pin");
DECL_STATIC_STRING(pwm_missed, "Missed scheduling of next hard pwm event");
DECL_STATIC_STRING(pwm_exceeds, "Scheduled pwm event will exceed max_duration");

static bool pwm_apply(struct node *node, struct timed_output *output, uint32_t value, uint32_t clock) {
    struct pwm_out *p = (struct pwm_out *)output;
    (void)clock;
    board_pwm_write(node, p->pin, value);
    return value == p->default_value;
}

static const struct timed_output_kind pwm_kind = {pwm_apply, NULL, &string_pwm_missed, &string_pwm_exceeds};

DECL_COMMAND(command_config_pwm_out,
             "config_pwm_out oid=%c pin=%u cycle_ticks=%u value=%hu default_value=%hu max_duration=%u");
void command_config_pwm_out(struct node *node, const struct wire_arg *args) {
    struct pwm_out *p = oid_alloc(node, (uint8_t)args[0].value, &pwm_out_type, sizeof(*p));
    if (!p)
        return;
    p->default_value = args[4].value;
    timed_output_setup(&p->output, &pwm_kind, args[5].value);
    if (board_pwm_setup(node, args[1].value, args[2].value, args[3].value, &p->pin))
        node_shutdown(node, string_not_a_pwm_pin);
}

DECL_COMMAND(command_queue_pwm_out, "queue_pwm_out oid=%c clock=%u value=%hu");
void command_queue_pwm_out(struct node *node, const struct wire_arg *args) {
    struct pwm_out *p = oid_lookup(node, (uint8_t)args[0].value, &pwm_out_type);
    if (p)
        timed_output_queue(node, &p->output, args[1].value, args[2].value);
}

DECL_SHUTDOWN_HOOK(pwm_out_shutdown);
void pwm_out_shutdown(struct node *node) {
    uint16_t oid = 0;
    struct pwm_out *p;
    while ((p = oid_next(node, &pwm_out_type, &oid))) {
        timed_output_stop(node, &p->output);
        board_pwm_write(node, p->pin, p->default_value);
    }
}
