// SPDX-License-Identifier: Apache-2.0
// sources: firmware/objects/tmcuart.c
// Which way the line is driven: simulated pins know no direction. With one pin for both ways the first bit
// makes it an output, and the turn an input again.
#include "tests/firmware/objects/lone_object.h"

enum { BIT_TIME = 400, BITS = 16 };

const uint16_t string_tmcuart_pin = 1, string_tmcuart_bit_time = 2, string_tmcuart_large = 3;
const struct node_response response_tmcuart_response;

static struct timer *added;
static char calls[64];

static void note(char what) {
    size_t length = strlen(calls);
    CHECK(length + 1 < sizeof calls);
    calls[length] = what;
}

int board_gpio_in(struct node *at, uint32_t pin, int pull) {
    CHECK(at == &node && pin == 71 && pull == 1);
    note('i');
    return 0;
}

int board_gpio_out(struct node *at, uint32_t pin, int value) {
    CHECK(at == &node && pin >= 71 && pin <= 72);
    note(value ? 'O' : 'o');
    return 0;
}

void board_gpio_write(struct node *at, uint32_t pin, int value) {
    CHECK(at == &node && pin >= 71 && pin <= 72);
    note(value ? '1' : '0');
}

int board_gpio_read(struct node *at, uint32_t pin) {
    CHECK(at == &node && pin == 71);
    return 1;
}

uint32_t board_clock(struct node *at) {
    CHECK(at == &node);
    return 1000;
}

void sched_add_timer(struct node *at, struct timer *timer) {
    CHECK(at == &node);
    added = timer;
}

void sched_add_timer_in(struct node *at, struct timer *timer, uint32_t ticks) {
    CHECK(at == &node && ticks);
    added = timer;
}

void sched_delete_timer(struct node *at, struct timer *timer) {
    CHECK(at == &node && timer);
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
    CHECK(at == &node && response == &response_tmcuart_response && count == 2);
    CHECK_EQUAL(args[0].value, OID);
    return 0;
}

void command_config_tmcuart(struct node *at, const struct wire_arg *args);
void command_tmcuart_send(struct node *at, const struct wire_arg *args);
void tmcuart_shutdown(struct node *at);

static void run(uint32_t tx_pin, const char *configured, const char *sent, const char *stopped) {
    static const uint8_t data[BITS / 8] = {0x05, 0xC3};
    memset(calls, 0, sizeof calls);
    command_config_tmcuart(
        &node, (const struct wire_arg[5]){
                   {.value = OID}, {.value = 71}, {.value = 1}, {.value = tx_pin}, {.value = BIT_TIME}});
    CHECK(!strcmp(calls, configured));
    memset(calls, 0, sizeof calls);
    const struct wire_arg send[3] = {{.value = OID}, {.value = sizeof data, .data = data}, {.value = 0}};
    command_tmcuart_send(&node, send);
    for (int bit = 0; bit < BITS; bit++)
        CHECK_EQUAL(added->function(&node, added), TIMER_AGAIN);
    CHECK_EQUAL(added->function(&node, added), TIMER_DONE);
    CHECK(!strcmp(calls, sent));
    memset(calls, 0, sizeof calls);
    tmcuart_shutdown(&node);
    CHECK(!strcmp(calls, stopped));
}

int main(void) {
    run(71, "i", "O010000011000011i", "i");
    run(72, "iO", "O010000011000011", "1");
    return 0;
}
