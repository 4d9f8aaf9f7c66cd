// SPDX-License-Identifier: Apache-2.0
// Pins are memory. Every change of an output is logged with its clock: the truth about what a node did.
//
// The log: a header of 64 bytes (see struct header), then one little-endian word a change:
//     clock (48 bits) << 16 | pin (15 bits) << 1 | level
#include <string.h>

#include "boards/linux/linux_board.h"

DECL_CONSTANT("ADC_MAX", 4095);
DECL_CONSTANT("PWM_MAX", 255);
// The names that printer boards use, so that their configurations work as they are.
DECL_ENUMERATION_RANGE("pin", "PA0", 0, 16);
DECL_ENUMERATION_RANGE("pin", "PB0", 16, 16);
DECL_ENUMERATION_RANGE("pin", "PC0", 32, 16);
DECL_ENUMERATION_RANGE("pin", "PD0", 48, 16);
DECL_ENUMERATION_RANGE("pin", "PE0", 64, 16);
DECL_ENUMERATION_RANGE("pin", "PF0", 80, 16);
DECL_ENUMERATION_RANGE("pin", "PG0", 96, 16);
DECL_ENUMERATION_RANGE("pin", "PH0", 112, 16);
DECL_ENUMERATION_RANGE("pin", "PI0", 128, 16);

enum { ANALOG_MIDDLE = 2048, LOG_BUFFER = 1 << 18 };

struct header {
    char magic[8];
    double clock_freq;       // nominal, ticks/s
    double true_ticks_per_s; // of CLOCK_MONOTONIC
    int64_t start_ns;        // CLOCK_MONOTONIC at which the clock stood at
    uint64_t start_clock;    // this
    uint8_t zero[24];
};

int edge_log_open(struct linux_board *board) {
    if (!board->options.edge_log)
        return 0;
    struct header header = {
        .magic = {'C', 'N', 'D', 'E', 'D', 'G', 'E', '1'},
        .clock_freq = BOARD_CLOCK_FREQ,
        .true_ticks_per_s = (double)board->rate_mHz / 1000,
        .start_ns = board->start_ns,
        .start_clock = board->options.start_clock,
    };
    board->edge_log = fopen(board->options.edge_log, "wb");
    if (!board->edge_log || fwrite(&header, sizeof(header), 1, board->edge_log) != 1)
        return -1;
    return setvbuf(board->edge_log, NULL, _IOFBF, LOG_BUFFER);
}

void edge_log_close(struct linux_board *board) {
    if (board->edge_log)
        fclose(board->edge_log);
    board->edge_log = NULL;
}

static void set_level(struct linux_board *board, uint32_t pin, bool level) {
    if (board->levels[pin] == level)
        return;
    board->levels[pin] = level;
    board->edges++;
    if (!board->edge_log)
        return;
    uint64_t record = clock_now(board) << 16 | (uint64_t)pin << 1 | level;
    fwrite(&record, sizeof(record), 1, board->edge_log);
}

void pins_reset(struct linux_board *board) {
    for (uint32_t pin = 0; pin < PINS; pin++) {
        set_level(board, pin, false);
        board->analog[pin] = ANALOG_MIDDLE;
    }
}

static int take_pin(uint32_t pin, struct board_pin *out) {
    if (pin >= PINS)
        return -1;
    *out = (struct board_pin){.mask = pin};
    return 0;
}

int board_gpio_out_setup(struct node *node, uint32_t pin, bool level, struct board_pin *out) {
    if (take_pin(pin, out))
        return -1;
    set_level(board_of(node), pin, level);
    return 0;
}

void board_gpio_write(struct node *node, struct board_pin pin, bool level) {
    set_level(board_of(node), pin.mask, level);
}

void board_gpio_toggle(struct node *node, struct board_pin pin) {
    struct linux_board *board = board_of(node);
    set_level(board, pin.mask, !board->levels[pin.mask]);
}

int board_gpio_in_setup(struct node *node, uint32_t pin, int8_t pull_up, struct board_pin *out) {
    if (take_pin(pin, out))
        return -1;
    board_of(node)->levels[pin] = pull_up > 0; // an open switch
    return 0;
}

bool board_gpio_read(struct node *node, struct board_pin pin) {
    return board_of(node)->levels[pin.mask];
}

int board_pwm_setup(struct node *node, uint32_t pin, uint32_t cycle_ticks, uint32_t value,
                    struct board_pin *out) {
    (void)cycle_ticks;
    if (take_pin(pin, out))
        return -1;
    board_pwm_write(node, *out, value);
    return 0;
}

// In the log a PWM output shows whether it is on at all.
void board_pwm_write(struct node *node, struct board_pin pin, uint32_t value) {
    set_level(board_of(node), pin.mask, value != 0);
}

int board_adc_setup(struct node *node, uint32_t pin, struct board_pin *out) {
    (void)node;
    return take_pin(pin, out);
}

uint16_t board_adc_read(struct node *node, struct board_pin pin) {
    return board_of(node)->analog[pin.mask];
}
