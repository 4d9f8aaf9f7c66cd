// SPDX-License-Identifier: Apache-2.0
// The board `linux`: a process is a node. For machines without hardware, and for the tests.
//
// Time. The board's clock runs at an adjustable true rate against CLOCK_MONOTONIC. A process is dispatched
// late by its kernel; so that this does not look like late steps, the clock stands at a timer's own wake-up
// while that timer runs: an infinitely fast chip. Commands and tasks see the real clock, so a command that
// comes too late is late. How late the kernel dispatched timers is measured and reported.
#ifndef BOARDS_LINUX_BOARD_H
#define BOARDS_LINUX_BOARD_H

#include <stdio.h>

#include "boards/board.h"
#include "net/can_stream.h"

#ifndef BOARD_CLOCK_FREQ
#error "the build says -DBOARD_CLOCK_FREQ=... -DBOARD_MCU=\"...\" -DBOARD_MOVE_COUNT=..."
#endif

enum {
    PORTS = 9, // PA .. PI
    PINS_PER_PORT = 16,
    PINS = PORTS * PINS_PER_PORT,
    ARENA_SIZE = 1 << 17,
    OUT_ROOM = 1 << 12, // bytes waiting for the bus, or to the host of a UART
};

// The command line.
struct options {
    const char *can, *socketcan, *uart, *edge_log;
    uint8_t uuid[CAN_UUID_SIZE];
    double rate_ppm;
    uint64_t start_clock;
    uint32_t jitter_us, slice_us;
    uint64_t seed;
};

// Fills OPTIONS; returns 0, or the exit status after one sentence on stderr.
int options_parse(struct options *options, int argc, char **argv);

struct linux_board {
    struct node node; // first: the core knows the node only
    struct options options;
    struct can_stream can_stream;

    // Clock.
    int64_t start_ns;
    uint64_t rate_mHz; // true ticks in 1000 s
    bool in_timer;
    uint64_t timer_clock; // 64 bits, while in_timer

    // Pins.
    bool levels[PINS];
    uint16_t analog[PINS];
    FILE *edge_log;
    uint64_t edges;

    // Bus or UART.
    int fd, slave_fd, signal_fd;
    bool closed; // the other end is gone
    uint8_t in[16 * 64];
    size_t in_size;
    uint8_t out[OUT_ROOM];
    size_t out_from, out_to;
    bool was_full;

    bool reset_wanted;
    uint64_t random;
    // Figures.
    uint64_t bytes_in, bytes_out, frames_in, frames_out, frames_bad, timers;
    uint64_t late_ticks_max, late_ticks_sum;
    uint8_t arena[ARENA_SIZE] __attribute__((aligned(16)));
};

static inline struct linux_board *board_of(struct node *node) {
    return (struct linux_board *)(void *)node;
}

// clock.c
int64_t monotonic_ns(void);
uint64_t clock_at(const struct linux_board *board, int64_t ns);
int64_t ns_at(const struct linux_board *board, uint64_t clock);
uint64_t clock_now(const struct linux_board *board);

// pins.c. Opens and closes the log of pin levels; open returns -1 when the file cannot be written.
int edge_log_open(struct linux_board *board);
void edge_log_close(struct linux_board *board);
void pins_reset(struct linux_board *board);

// wires.c. Opens what the options name; -1 after one sentence on stderr.
int wires_open(struct linux_board *board);
void wires_close(struct linux_board *board);
void wires_read(struct linux_board *board);
void wires_write(struct linux_board *board);

#endif
