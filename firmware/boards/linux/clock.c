// SPDX-License-Identifier: Apache-2.0
// The board's clock: its own rate and offset, derived from CLOCK_MONOTONIC.
#include <time.h>

#include "boards/linux/linux_board.h"

DECL_CONSTANT("CLOCK_FREQ", BOARD_CLOCK_FREQ);
DECL_CONSTANT_STR("MCU", BOARD_MCU);

static const uint64_t NS_MHZ = 1000000000000; // ns · mHz in a tick

int64_t monotonic_ns(void) {
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    return (int64_t)now.tv_sec * 1000000000 + now.tv_nsec;
}

uint64_t clock_at(const struct linux_board *board, int64_t ns) {
    __extension__ unsigned __int128 product =
        (unsigned __int128)(uint64_t)(ns - board->start_ns) * board->rate_mHz;
    return board->options.start_clock + (uint64_t)(product / NS_MHZ);
}

int64_t ns_at(const struct linux_board *board, uint64_t clock) {
    __extension__ unsigned __int128 product =
        (unsigned __int128)(clock - board->options.start_clock) * NS_MHZ;
    // Rounded up: at this time the clock has reached CLOCK.
    return board->start_ns + (int64_t)((product + board->rate_mHz - 1) / board->rate_mHz);
}

uint64_t clock_now(const struct linux_board *board) {
    return board->in_timer ? board->timer_clock : clock_at(board, monotonic_ns());
}

uint32_t board_clock(struct node *node) {
    return (uint32_t)clock_now(board_of(node));
}

uint32_t board_busy_clock(struct node *node) {
    return board_clock(node);
}

// Timers run between tasks, never during one: there is nothing to keep out.
uint32_t board_irq_save(struct node *node) {
    (void)node;
    return 0;
}

void board_irq_restore(struct node *node, uint32_t state) {
    (void)node;
    (void)state;
}
