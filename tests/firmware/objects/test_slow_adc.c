// SPDX-License-Identifier: Apache-2.0
// sources: firmware/objects/analog_in.c
// An analog input on a board whose converter needs time, as those of real chips do: simulated boards answer
// at once.
#include "tests/firmware/objects/lone_object.h"

enum { PIN = 50, CONVERSION = 700, BEGIN = 1000, APART = 10000, REST = 1000000, COUNT = 3 };

const uint16_t string_adc_range = 1, string_adc_pin = 2, string_adc_report = 3;
const struct node_response response_analog_in_state;

static struct timer *added, *deleted;
static uint32_t asked_at, conversions, reported_clock;

int board_adc_setup(struct node *at, uint32_t pin) {
    CHECK(at == &node && pin == PIN);
    return 0;
}

// Begins to convert, and has the value CONVERSION later.
uint32_t board_adc_sample(struct node *at, uint32_t pin, uint16_t *value) {
    CHECK(at == &node && pin == PIN && added);
    if (asked_at != added->waketime - CONVERSION) {
        asked_at = added->waketime;
        return CONVERSION;
    }
    *value = (uint16_t)++conversions;
    return 0;
}

void sched_add_timer(struct node *at, struct timer *timer) {
    CHECK(at == &node);
    added = timer;
}

void sched_delete_timer(struct node *at, struct timer *timer) {
    CHECK(at == &node);
    deleted = timer;
}

void node_shutdown(struct node *at, uint16_t reason) {
    (void)at;
    CHECK_EQUAL(reason, 0);
}

int node_can_respond(const struct node *at) {
    return at == &node;
}

int node_respond(struct node *at, const struct node_response *response, const struct wire_arg *args,
                 size_t count) {
    CHECK(at == &node && response == &response_analog_in_state && count == 3);
    CHECK_EQUAL(args[0].value, OID);
    reported_clock = args[1].value;
    CHECK_EQUAL(args[2].value, 2);
    CHECK_EQUAL(args[2].data[0] | args[2].data[1] << 8, 1 + 2 + 3);
    return 0;
}

void command_config_analog_in(struct node *at, const struct wire_arg *args);
void command_query_analog_in(struct node *at, const struct wire_arg *args);
void analog_in_task(struct node *at);
void analog_in_shutdown(struct node *at);

int main(void) {
    command_config_analog_in(&node, (const struct wire_arg[2]){{.value = OID}, {.value = PIN}});
    const struct wire_arg query[9] = {{.value = OID},   {.value = BEGIN}, {.value = APART},
                                      {.value = COUNT}, {.value = REST},  {.value = 2},
                                      {.value = 0},     {.value = 65535}, {.value = 1}};
    command_query_analog_in(&node, query);
    // Each sample is begun at its time and read when it is there; the next begins APART after that.
    for (uint32_t sample = 0; sample < COUNT; sample++) {
        CHECK_EQUAL(added->waketime, BEGIN + sample * (CONVERSION + APART));
        CHECK_EQUAL(added->function(&node, added), TIMER_AGAIN);
        CHECK_EQUAL(added->waketime, BEGIN + sample * (CONVERSION + APART) + CONVERSION);
        CHECK_EQUAL(added->function(&node, added), TIMER_AGAIN);
        CHECK_EQUAL(conversions, sample + 1);
    }
    CHECK_EQUAL(added->waketime, BEGIN + REST); // however long the samples took
    analog_in_task(&node);
    CHECK_EQUAL(reported_clock, BEGIN + REST);
    // What was to be reported when the node shuts down is not.
    conversions = reported_clock = 0;
    for (int call = 0; call < 2 * COUNT; call++)
        CHECK_EQUAL(added->function(&node, added), TIMER_AGAIN);
    deleted = NULL;
    analog_in_shutdown(&node);
    CHECK(deleted == added);
    analog_in_task(&node);
    CHECK_EQUAL(reported_clock, 0);
    return 0;
}
