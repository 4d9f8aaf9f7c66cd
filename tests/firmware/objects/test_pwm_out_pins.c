// SPDX-License-Identifier: Apache-2.0
// sources: firmware/objects/pwm_out.c
// What a hardware PWM's configuration asks of the board and of its timed output: a simulated board's pins
// know no cycle.
#include "objects/timed_output.h"
#include "tests/firmware/objects/lone_object.h"

const uint16_t string_missed_pwm = 1, string_exceeds_pwm = 2, string_invalid_pwm_pin = 3;

static struct timed_output *output;
static uint32_t pin, cycle, value, written, updated, stopped, shutdowns, inits;
static int answer;

int board_pwm_setup(struct node *at, uint32_t asked_pin, uint32_t cycle_ticks, uint16_t asked_value) {
    CHECK(at == &node);
    pin = asked_pin, cycle = cycle_ticks, value = asked_value;
    return answer;
}

void board_pwm_write(struct node *at, uint32_t asked_pin, uint16_t asked_value) {
    CHECK(at == &node && asked_pin == 41);
    written = asked_value;
}

void node_shutdown(struct node *at, uint16_t reason) {
    CHECK(at == &node);
    CHECK_EQUAL(reason, string_invalid_pwm_pin);
    shutdowns++;
}

void timed_output_init(struct timed_output *at) {
    output = at;
    inits++;
}

void timed_output_update(struct node *at, struct timed_output *which, uint32_t to) {
    CHECK(at == &node && which == output);
    updated = to;
}

void timed_output_queue(struct node *at, struct timed_output *which, uint32_t clock, uint32_t to) {
    CHECK(at == &node && which == output && clock == 123 && to == 45);
}

void timed_output_stop(struct node *at, struct timed_output *which) {
    CHECK(at == &node && which == output);
    stopped++;
}

void command_config_pwm_out(struct node *at, const struct wire_arg *args);
void command_queue_pwm_out(struct node *at, const struct wire_arg *args);
void pwm_out_shutdown(struct node *at);

int main(void) {
    const struct wire_arg args[6] = {{.value = OID}, {.value = 41}, {.value = 1000},
                                     {.value = 300}, {.value = 7},  {.value = 5000}};
    command_config_pwm_out(&node, args);
    CHECK(pin == 41 && cycle == 1000 && value == 300);
    CHECK_EQUAL(updated, 300);
    CHECK(inits == 1 && created == 1);
    CHECK(output->default_value == 7 && output->max_duration == 5000);
    CHECK(output->missed == string_missed_pwm && output->exceeded == string_exceeds_pwm);
    output->apply(&node, output, 99, 32768);
    CHECK_EQUAL(written, 32768);
    command_queue_pwm_out(&node, (const struct wire_arg[3]){{.value = OID}, {.value = 123}, {.value = 45}});
    pwm_out_shutdown(&node);
    CHECK_EQUAL(stopped, 1);
    answer = -1;
    command_config_pwm_out(&node, args);
    CHECK(shutdowns == 1 && created == 1 && inits == 1);
    return 0;
}
