// SPDX-License-Identifier: Apache-2.0
// What a board provides to the chip-free firmware: these functions, resolved when linking, and nothing else.
// A board calls in through core/node.h and net/*.h. docs/firmware.md lists the steps of a port.
#ifndef BOARDS_BOARD_H
#define BOARDS_BOARD_H

#include <stdbool.h>
#include <stdint.h>

struct node;

// ----------------------------------------------------------------------------------------------------- time

// The free-running 32-bit clock.
uint32_t board_clock(struct node *node);
// A clock for the load figure only: the same one, but where board_clock() stands still while a task runs.
uint32_t board_busy_clock(struct node *node);

// ----------------------------------------------------------------------------------------------- interrupts

// Disables interrupts; the result goes to board_irq_restore. Pairs nest.
uint32_t board_irq_save(struct node *node);
void board_irq_restore(struct node *node, uint32_t state);

// ----------------------------------------------------------------------------------------------------- pins

// A pin made ready for fast access; what the fields mean is the board's affair.
struct board_pin {
    void *port;
    uint32_t mask;
};

// Set-up functions return 0, or -1 when the pin cannot do it.
int board_gpio_out_setup(struct node *node, uint32_t pin, bool level, struct board_pin *out);
void board_gpio_write(struct node *node, struct board_pin pin, bool level);
void board_gpio_toggle(struct node *node, struct board_pin pin);
// PULL_UP: 1 pull-up, 0 floating, -1 pull-down.
int board_gpio_in_setup(struct node *node, uint32_t pin, int8_t pull_up, struct board_pin *out);
bool board_gpio_read(struct node *node, struct board_pin pin);
// Hardware PWM: VALUE is 0 .. the constant PWM_MAX.
int board_pwm_setup(struct node *node, uint32_t pin, uint32_t cycle_ticks, uint32_t value,
                    struct board_pin *out);
void board_pwm_write(struct node *node, struct board_pin pin, uint32_t value);
// One conversion, 0 .. the constant ADC_MAX; short enough for interrupt context.
int board_adc_setup(struct node *node, uint32_t pin, struct board_pin *out);
uint16_t board_adc_read(struct node *node, struct board_pin pin);

// ------------------------------------------------------------------------------------------------ transport

// Queues a frame of 0..8 bytes. Returns false when there is no room; then the board calls
// link_transmit_ready() when there is.
bool board_can_send(struct node *node, uint32_t id, const uint8_t *data, uint8_t size);
// Accepts all FILTERS ids given here (3 at most) and may deliver others too.
void board_can_filter(struct node *node, const uint32_t *ids, uint8_t count);
struct board_can_status {
    uint32_t rx_error, tx_error, tx_retries, bus_state; // bus_state: 0 active, 1 warn, 2 passive, 3 off
};
void board_can_status(struct node *node, struct board_can_status *status);
// Queues up to SIZE bytes; returns how many. When fewer, link_transmit_ready() follows.
uint32_t board_uart_send(struct node *node, const uint8_t *data, uint32_t size);

// ---------------------------------------------------------------------------------------------------- reset

// Restarts the node soon, as power-on does; returns.
void board_request_reset(struct node *node);

#endif
