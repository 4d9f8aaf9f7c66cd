// SPDX-License-Identifier: Apache-2.0
// sources: firmware/objects/endstop.c
// What an endstop's configuration asks of the board, and that its shutdown hook leaves no timer: the rest of
// it is tested on a simulated board, whose pins know no pull-up.
#include "objects/trsync.h"
#include "tests/firmware/objects/lone_object.h"

const uint16_t string_invalid_input_pin = 3;
const struct node_response response_endstop_state;

static uint32_t asked_pin, deleted, shutdowns;
static int asked_pull, answer;

int board_gpio_in(struct node *at, uint32_t pin, int pull) {
    CHECK(at == &node);
    asked_pin = pin, asked_pull = pull;
    return answer;
}

int board_gpio_read(struct node *at, uint32_t pin) {
    CHECK(at == &node && pin == asked_pin);
    return 1;
}

void sched_add_timer(struct node *at, struct timer *timer) {
    CHECK(at == &node && timer);
}

void sched_delete_timer(struct node *at, struct timer *timer) {
    CHECK(at == &node && timer == (struct timer *)object);
    deleted++;
}

void node_shutdown(struct node *at, uint16_t reason) {
    CHECK(at == &node);
    CHECK_EQUAL(reason, string_invalid_input_pin);
    shutdowns++;
}

int node_respond(struct node *at, const struct node_response *response, const struct wire_arg *args,
                 size_t count) {
    (void)args;
    CHECK(at == &node && response == &response_endstop_state && count == 4);
    return 0;
}

struct trsync *trsync_find(struct node *at, uint32_t oid) {
    (void)at;
    (void)oid;
    return NULL;
}

void trsync_trigger(struct node *at, struct trsync *trsync, uint8_t reason) {
    (void)at;
    (void)trsync;
    (void)reason;
}

void command_config_endstop(struct node *at, const struct wire_arg *args);
void endstop_shutdown(struct node *at);

int main(void) {
    for (int pull = -1; pull <= 1; pull++) {
        const struct wire_arg args[4] = {
            {.value = OID}, {.value = 20}, {.value = (uint8_t)pull}, {.value = 77}};
        command_config_endstop(&node, args);
        CHECK_EQUAL(asked_pin, 20);
        CHECK_EQUAL(asked_pull, pull);
    }
    CHECK_EQUAL(created, 3);
    answer = -1;
    command_config_endstop(&node, (const struct wire_arg[3]){{.value = OID}, {.value = 20}});
    CHECK(shutdowns == 1 && created == 3);
    endstop_shutdown(&node);
    CHECK_EQUAL(deleted, 1);
    return 0;
}
