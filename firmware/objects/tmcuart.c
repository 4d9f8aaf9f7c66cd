// SPDX-License-Identifier: Apache-2.0
// The UART of stepper drivers, bit by bit on any pins; perhaps one pin both ways. The host gives bits as they
// go over the wire, start and stop bits included, lowest first, and gets them back the same way: nothing here
// knows what they mean.
//
// Writing, each bit lasts bit_time ticks. Reading, the line is looked at four times per bit until a start bit
// comes, then every bit is read near its middle: what another clock adds up to over 80 bits is harmless below
// 0.4 %. When no start bit comes, the answer is empty.
#include "boards/board.h"

#include <string.h>

DECL_STATIC_STRING(tmcuart_pin, "Not a valid tmcuart pin");
DECL_STATIC_STRING(tmcuart_bit_time, "Invalid tmcuart bit time");
DECL_STATIC_STRING(tmcuart_large, "tmcuart data too large");

DECL_RESPONSE(tmcuart_response, "tmcuart_response oid=%c read=%*s");

enum {
    DATA_MAX = 10, // bytes: 80 bits are the longest datagram, eight bytes of ten bits
    LOOKS = 4,     // per bit, for the start bit
    WAIT_BITS = 150,
    BEGIN_BITS = 4, // from the command to the first bit
    BIT_TIME_MIN = LOOKS * 2,
    BIT_TIME_MAX = 1 << 20,
};

enum tmcuart_state { IDLE, WRITING, WAITING, READING, ANSWERING };

struct tmcuart {
    struct timer timer;
    uint32_t rx_pin, tx_pin, bit_time, give_up_clock;
    int8_t pull_up;
    uint8_t state;
    uint8_t bit, write_bits, read_bits;
    uint8_t data[DATA_MAX]; // being written, then what was read
};

static const struct oid_type tmcuart_type = {"tmcuart"};

static enum timer_result finish(struct node *node, struct tmcuart *uart, uint8_t read_bits) {
    uart->read_bits = read_bits;
    uart->state = ANSWERING;
    node_wake_tasks(node);
    return TIMER_DONE;
}

// The last bit's time is over: the line is the other side's.
static enum timer_result turn_round(struct node *node, struct tmcuart *uart) {
    if (uart->rx_pin == uart->tx_pin)
        board_gpio_in(node, uart->rx_pin, uart->pull_up);
    if (!uart->read_bits)
        return finish(node, uart, 0);
    memset(uart->data, 0, sizeof(uart->data));
    uart->bit = 0;
    uart->state = WAITING;
    uart->give_up_clock = uart->timer.waketime + WAIT_BITS * uart->bit_time;
    uart->timer.waketime += uart->bit_time / LOOKS;
    return TIMER_AGAIN;
}

static enum timer_result write_bit(struct node *node, struct tmcuart *uart) {
    if (uart->bit == uart->write_bits)
        return turn_round(node, uart);
    int level = uart->data[uart->bit / 8] >> (uart->bit % 8) & 1;
    if (uart->bit == 0)
        board_gpio_out(node, uart->tx_pin, level);
    else
        board_gpio_write(node, uart->tx_pin, level);
    uart->bit++;
    uart->timer.waketime += uart->bit_time;
    return TIMER_AGAIN;
}

// A start bit began since the look before, so 3/8 of a bit on is at 3/8 to 5/8 of it.
static enum timer_result look_for_start(struct node *node, struct tmcuart *uart) {
    if (!board_gpio_read(node, uart->rx_pin)) {
        uart->state = READING;
        uart->timer.waketime += uart->bit_time * 3 / 8;
        return TIMER_AGAIN;
    }
    if (!clock_before(uart->timer.waketime, uart->give_up_clock))
        return finish(node, uart, 0);
    uart->timer.waketime += uart->bit_time / LOOKS;
    return TIMER_AGAIN;
}

static enum timer_result read_bit(struct node *node, struct tmcuart *uart) {
    if (board_gpio_read(node, uart->rx_pin))
        uart->data[uart->bit / 8] |= (uint8_t)(1 << (uart->bit % 8));
    if (++uart->bit == uart->read_bits)
        return finish(node, uart, uart->read_bits);
    uart->timer.waketime += uart->bit_time;
    return TIMER_AGAIN;
}

static enum timer_result tmcuart_event(struct node *node, struct timer *timer) {
    struct tmcuart *uart = (struct tmcuart *)timer;
    switch (uart->state) {
    case WRITING:
        return write_bit(node, uart);
    case WAITING:
        return look_for_start(node, uart);
    case READING:
        return read_bit(node, uart);
    default:
        return TIMER_DONE;
    }
}

void command_config_tmcuart(struct node *node, const struct wire_arg *args) {
    uint32_t rx_pin = args[1].value, tx_pin = args[3].value, bit_time = args[4].value;
    if (bit_time < BIT_TIME_MIN || bit_time > BIT_TIME_MAX) {
        node_shutdown(node, STRING(tmcuart_bit_time));
        return;
    }
    if (board_gpio_in(node, rx_pin, (int8_t)args[2].value) ||
        (tx_pin != rx_pin && board_gpio_out(node, tx_pin, 1))) {
        node_shutdown(node, STRING(tmcuart_pin));
        return;
    }
    struct tmcuart *uart = oid_create(node, args[0].value, &tmcuart_type, sizeof(*uart));
    if (!uart)
        return;
    uart->rx_pin = rx_pin;
    uart->tx_pin = tx_pin;
    uart->pull_up = (int8_t)args[2].value;
    uart->bit_time = bit_time;
    uart->timer.function = tmcuart_event;
}
DECL_COMMAND(command_config_tmcuart, "config_tmcuart oid=%c rx_pin=%u pull_up=%c tx_pin=%u bit_time=%u", 0);

// While it is busy another one is dropped without a word: its host asks again, as it does for one that got
// lost.
void command_tmcuart_send(struct node *node, const struct wire_arg *args) {
    struct tmcuart *uart = oid_find(node, args[0].value, &tmcuart_type);
    if (!uart || uart->state != IDLE)
        return;
    if (args[1].value > DATA_MAX || args[2].value > DATA_MAX) {
        node_shutdown(node, STRING(tmcuart_large));
        return;
    }
    memcpy(uart->data, args[1].data, args[1].value);
    uart->write_bits = (uint8_t)(args[1].value * 8);
    uart->read_bits = (uint8_t)(args[2].value * 8);
    uart->bit = 0;
    uart->state = WRITING;
    uint32_t irq = board_irq_save(node);
    sched_add_timer_in(node, &uart->timer, BEGIN_BITS * uart->bit_time);
    board_irq_restore(node, irq);
}
DECL_COMMAND(command_tmcuart_send, "tmcuart_send oid=%c write=%*s read=%c", 0);

void tmcuart_task(struct node *node) {
    struct tmcuart *uart;
    for (unsigned oid = 0; (uart = oid_next(node, &oid, &tmcuart_type));) {
        if (uart->state != ANSWERING || !node_can_respond(node))
            continue;
        RESPOND(node, tmcuart_response, INT(oid - 1), BYTES(uart->data, uart->read_bits / 8));
        uart->state = IDLE;
    }
}
DECL_TASK(tmcuart_task);

// The line is let go of, or high: a driver that hears half a datagram forgets it.
void tmcuart_shutdown(struct node *node) {
    struct tmcuart *uart;
    for (unsigned oid = 0; (uart = oid_next(node, &oid, &tmcuart_type));) {
        sched_delete_timer(node, &uart->timer);
        uart->state = IDLE;
        if (uart->tx_pin == uart->rx_pin)
            board_gpio_in(node, uart->rx_pin, uart->pull_up);
        else
            board_gpio_write(node, uart->tx_pin, 1);
    }
}
DECL_SHUTDOWN_HOOK(tmcuart_shutdown);
