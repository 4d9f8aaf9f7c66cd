// SPDX-License-Identifier: Apache-2.0
// What the boards without a chip (linux, sim) share: pins in memory, a log of every change of an output, and
// perhaps a plant behind the pins.
#ifndef BOARDS_VIRTUAL_H
#define BOARDS_VIRTUAL_H

#include "boards/board.h"
#include "plant/plant.h"

// Converters idle at what a 100 kOhm thermistor at 25 °C gives below 4.7 kOhm: sensors without a plant are
// sound.
//
// For debug_read and debug_write there are VIRTUAL_SCRATCH bytes from VIRTUAL_SCRATCH_BASE on, and nothing
// else: a process's own memory is not the host's business. A reset clears them.
enum { VIRTUAL_SCRATCH_BASE = 0x20000000, VIRTUAL_SCRATCH = 256 };
enum { VIRTUAL_PINS = PLANT_PINS, VIRTUAL_ADC_MAX = 4095, VIRTUAL_PWM_MAX = 32768, VIRTUAL_ADC_IDLE = 3911 };

// First member of a board's own struct; its first member in turn is the node.
struct virtual_board {
    struct node node;
    uint8_t level[VIRTUAL_PINS];
    uint16_t adc[VIRTUAL_PINS], pwm[VIRTUAL_PINS];
    uint32_t scratch[VIRTUAL_SCRATCH / sizeof(uint32_t)];
    // Changes of outputs, oldest first: clock (48 bits) << 16 | pin << 1 | level.
    uint64_t *edges;
    size_t edge_count, edge_room;
    uint64_t edges_total;
    // Of a board's owner that simulates what is around it; null where there is none. on_edge: an output has
    // changed and stands at the end of the edges.
    void (*on_edge)(struct virtual_board *board, uint32_t pin, int level);
    void (*can_status)(struct virtual_board *board, struct board_can_status *out);
    struct plant *plant; // what its pins are connected with; null: nothing
    uint32_t irq_depth;  // sections of masked interrupts that have begun and not ended
};

// What one variant of the boards is built as (constants.c).
struct virtual_variant {
    uint32_t clock_freq;
    uint16_t move_count;
};
extern const struct virtual_variant virtual_variant;

// All pins low, all converters idle. Outputs that were high are logged as falling.
void virtual_pins_reset(struct virtual_board *board);

// Ends the process, which is a fault of the firmware, when interrupts are still masked. Call between events.
void virtual_irq_check(const struct virtual_board *board);

// From the board: its clock in 64 bits, the true time of that in ns, and more room in (or a flush of) the
// full edge buffer.
uint64_t virtual_clock(struct virtual_board *board);
uint64_t virtual_true_ns(struct virtual_board *board);
void virtual_edges_full(struct virtual_board *board);

#endif
