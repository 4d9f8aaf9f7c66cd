// SPDX-License-Identifier: Apache-2.0
// Pins in memory. An input reads what the plant says; where that has nothing, what the board's owner (or an
// output on the same pin) last put there.
#include "boards/virtual/virtual.h"

#include <stdio.h>
#include <stdlib.h>
#include <string.h>

DECL_ENUMERATION_RANGE("pin", "PA0", 0, 16);
DECL_ENUMERATION_RANGE("pin", "PB0", 16, 16);
DECL_ENUMERATION_RANGE("pin", "PC0", 32, 16);
DECL_ENUMERATION_RANGE("pin", "PD0", 48, 16);
DECL_ENUMERATION_RANGE("pin", "PE0", 64, 16);
DECL_ENUMERATION_RANGE("pin", "PF0", 80, 16);
DECL_ENUMERATION_RANGE("pin", "PG0", 96, 16);
DECL_ENUMERATION_RANGE("pin", "PH0", 112, 16);
DECL_ENUMERATION_RANGE("pin", "PI0", 128, 16);
DECL_ENUMERATION("pin", "ADC_TEMPERATURE", 254);

// The chip's own sensor: always 35 degrees by the line of RP2040, (0.706 - 8 * 0.001721) / 3.3 of full scale.
enum { CHIP_PIN = 254, CHIP_SAMPLE = 859 };

DECL_CONSTANT("DEBUG_MEMORY", 536870912);
DECL_CONSTANT("DEBUG_MEMORY_SIZE", 256);
DECL_CONSTANT("ADC_MAX", 4095);
DECL_CONSTANT("PWM_MAX", 32768);
_Static_assert(VIRTUAL_SCRATCH_BASE == 536870912 && VIRTUAL_SCRATCH == 256, "likewise");
_Static_assert(VIRTUAL_ADC_MAX == 4095 && VIRTUAL_PWM_MAX == 32768, "the constants above tell the host");

static struct virtual_board *board_of(struct node *node) {
    return (struct virtual_board *)node;
}

static int check(uint32_t pin) {
    return pin < VIRTUAL_PINS ? 0 : -1;
}

static void set_output(struct virtual_board *board, uint32_t pin, int level) {
    uint8_t value = level != 0;
    if (board->plant && board->plant->cares[pin])
        plant_output(board->plant, virtual_true_ns(board), pin, value);
    if (board->level[pin] == value)
        return;
    board->level[pin] = value;
    if (board->edge_count == board->edge_room)
        virtual_edges_full(board);
    board->edges[board->edge_count++] = virtual_clock(board) << 16 | pin << 1 | value;
    board->edges_total++;
    if (board->on_edge)
        board->on_edge(board, pin, value);
}

static void set_pwm(struct virtual_board *board, uint32_t pin, uint16_t value) {
    board->pwm[pin] = value;
    if (board->plant)
        plant_pwm(board->plant, virtual_true_ns(board), pin, value);
}

void virtual_pins_reset(struct virtual_board *board) {
    struct plant *plant = board->plant;
    memset(board->scratch, 0, sizeof(board->scratch));
    if (plant)
        plant_reset(plant, virtual_true_ns(board));
    board->plant = NULL; // for it the pins float, whatever the log says
    for (uint32_t pin = 0; pin < VIRTUAL_PINS; pin++) {
        set_output(board, pin, 0);
        board->adc[pin] = VIRTUAL_ADC_IDLE;
        board->pwm[pin] = 0;
    }
    board->plant = plant;
}

int board_gpio_out(struct node *node, uint32_t pin, int level) {
    if (check(pin))
        return -1;
    set_output(board_of(node), pin, level);
    return 0;
}

void board_gpio_write(struct node *node, uint32_t pin, int level) {
    set_output(board_of(node), pin, level);
}

int board_gpio_in(struct node *node, uint32_t pin, int pull) {
    struct virtual_board *board = board_of(node);
    (void)pull; // what is not driven has its own level here
    if (!check(pin) && board->plant && board->plant->cares[pin])
        plant_float(board->plant, virtual_true_ns(board), pin);
    return check(pin);
}

int board_gpio_read(struct node *node, uint32_t pin) {
    struct virtual_board *board = board_of(node);
    if (board->plant && board->plant->reads[pin])
        return plant_input(board->plant, virtual_true_ns(board), pin, board->level[pin]);
    return board->level[pin];
}

int board_adc_setup(struct node *node, uint32_t pin) {
    (void)node;
    return pin == CHIP_PIN ? 0 : check(pin);
}

uint32_t board_adc_sample(struct node *node, uint32_t pin, uint16_t *value) {
    struct virtual_board *board = board_of(node);
    if (pin == CHIP_PIN) {
        *value = CHIP_SAMPLE;
        return 0;
    }
    *value = board->adc[pin];
    if (board->plant && board->plant->reads[pin])
        *value = plant_sample(board->plant, virtual_true_ns(board), pin, *value);
    return 0;
}

int board_pwm_setup(struct node *node, uint32_t pin, uint32_t cycle_ticks, uint16_t value) {
    (void)cycle_ticks;
    if (check(pin))
        return -1;
    set_pwm(board_of(node), pin, value);
    return 0;
}

void board_pwm_write(struct node *node, uint32_t pin, uint16_t value) {
    set_pwm(board_of(node), pin, value);
}

// What is on the buses only the plant knows; a transfer takes no time.
enum { I2C_BUSES = 2 };
DECL_ENUMERATION("i2c_bus", "i2c1", 0);
DECL_ENUMERATION("i2c_bus", "i2c2", 1);

int board_i2c_setup(struct node *node, uint32_t bus, uint32_t rate) {
    (void)node;
    return bus < I2C_BUSES && rate ? 0 : -1;
}

int board_i2c_transfer(struct node *node, uint32_t bus, uint8_t address, const uint8_t *write,
                       size_t write_size, uint8_t *read, size_t read_size) {
    struct virtual_board *board = board_of(node);
    if (!board->plant)
        return BOARD_I2C_START_NACK;
    int status =
        plant_i2c(board->plant, virtual_true_ns(board), bus, address, write, write_size, read, read_size);
    return status ? BOARD_I2C_START_NACK : BOARD_I2C_SUCCESS;
}

// Everything runs in one thread: nothing to mask.
// Nothing interrupts here; what matters on a chip is checked: every section that is masked ends.
static _Noreturn void irq_fault(void) {
    fprintf(stderr, "firmware: interrupts masked and not restored, or restored in another order\n");
    abort();
}

uint32_t board_irq_save(struct node *node) {
    return board_of(node)->irq_depth++;
}

void board_irq_restore(struct node *node, uint32_t state) {
    if (--board_of(node)->irq_depth != state)
        irq_fault();
}

void virtual_irq_check(const struct virtual_board *board) {
    if (board->irq_depth)
        irq_fault();
}

void board_can_status(struct node *node, struct board_can_status *out) {
    struct virtual_board *board = board_of(node);
    *out = (struct board_can_status){.state = BOARD_CAN_ACTIVE};
    if (board->can_status)
        board->can_status(board, out);
}

volatile void *board_memory(struct node *node, uint32_t addr, uint32_t size, int write) {
    (void)write; // all of it may be written
    uint32_t at = addr - VIRTUAL_SCRATCH_BASE;
    return at <= VIRTUAL_SCRATCH - size ? (uint8_t *)board_of(node)->scratch + at : NULL;
}
