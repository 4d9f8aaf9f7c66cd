// SPDX-License-Identifier: Apache-2.0
// What a board gives the core. Link-time functions: a build has one board, which finds its own state around
// the struct node (usually struct node is the first member of the board's struct).
#ifndef BOARDS_BOARD_H
#define BOARDS_BOARD_H

#include "core/node.h"

// The free-running clock, config.clock_freq ticks per second. May be read in every context.
uint32_t board_clock(struct node *node);

// Masks the interrupts in which timers and input run; restore with the returned state. May nest.
uint32_t board_irq_save(struct node *node);
void board_irq_restore(struct node *node, uint32_t state);

// Pins. The setup functions return -1 for a pin that cannot do it; the others are only called after setup.
int board_gpio_out(struct node *node, uint32_t pin, int level);
void board_gpio_write(struct node *node, uint32_t pin, int level);
int board_gpio_in(struct node *node, uint32_t pin, int pull); // pull 1: up, 0: none, -1: down
int board_gpio_read(struct node *node, uint32_t pin);
int board_adc_setup(struct node *node, uint32_t pin);
// Takes a sample of 0..ADC_MAX. Returns 0 with the sample, or the ticks after which to ask again.
uint32_t board_adc_sample(struct node *node, uint32_t pin, uint16_t *value);
// Hardware PWM with values 0..PWM_MAX.
int board_pwm_setup(struct node *node, uint32_t pin, uint32_t cycle_ticks, uint16_t value);
void board_pwm_write(struct node *node, uint32_t pin, uint16_t value);

// I2C buses of the board, by number. A transfer writes, then reads with a repeated start, and may take its
// time; tasks and commands only. The setup function returns -1 for a bus or a RATE (Hz) that it cannot do.
enum {
    BOARD_I2C_SUCCESS,
    BOARD_I2C_NACK,
    BOARD_I2C_BUS_TIMEOUT,
    BOARD_I2C_START_NACK,
    BOARD_I2C_START_READ_NACK,
};
int board_i2c_setup(struct node *node, uint32_t bus, uint32_t rate);
int board_i2c_transfer(struct node *node, uint32_t bus, uint8_t address, const uint8_t *write,
                       size_t write_size, uint8_t *read, size_t read_size);

// The CAN controller's own view of the bus (enumeration canbus_bus_state).
enum { BOARD_CAN_ACTIVE, BOARD_CAN_WARN, BOARD_CAN_PASSIVE, BOARD_CAN_OFF };
struct board_can_status {
    uint32_t rx_error, tx_error, tx_retries, state;
};
void board_can_status(struct node *node, struct board_can_status *out);

// Both links offer their bytes whenever tasks run; a board that refuses calls node_wake_tasks() when there is
// room again. Frames are also sent in interrupt context (core/bus_signals.h), perhaps while a task is in
// board_can_send(); those with ids below CAN_ID_URGENT_END leave before all data that still waits. A board
// does not give a node its own frames back.
int board_can_send(struct node *node, uint32_t id, const uint8_t *data, size_t size); // 0, or -1: busy
size_t board_uart_send(struct node *node, const uint8_t *data, size_t size);          // bytes taken

// The SIZE bytes at address ADDR (a multiple of SIZE: 1, 2 or 4) for debug_read and debug_write; null where
// the board does not allow it. Allow reading where it has no side effect (RAM, flash, registers that are not
// FIFOs), and writing where no output, timer or flash changes: what the firmware has nothing in.
volatile void *board_memory(struct node *node, uint32_t addr, uint32_t size, int write);

// Restart the node soon, as a power cycle would. Returns.
void board_reset(struct node *node);

#endif
