// SPDX-License-Identifier: Apache-2.0
// The node's clock from CLOCK_MONOTONIC. Doubles are exact here: no product exceeds 2^53 ticks (20 months at
// 168 MHz).
#include "boards/linux/linux.h"

#include <time.h>

static const double NS_PER_S = 1e9;

uint64_t monotonic_ns(void) {
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    return (uint64_t)now.tv_sec * 1000000000u + (uint64_t)now.tv_nsec;
}

uint64_t clock_at(const struct linux_board *board, uint64_t ns) {
    return board->start_clock + (uint64_t)((double)(ns - board->start_ns) * (board->rate / NS_PER_S));
}

uint64_t ns_of_clock(const struct linux_board *board, uint64_t clock) {
    if (clock < board->start_clock)
        return board->start_ns;
    return board->start_ns + (uint64_t)((double)(clock - board->start_clock) * (NS_PER_S / board->rate));
}

uint64_t virtual_clock(struct virtual_board *virtual) {
    const struct linux_board *board = (const struct linux_board *)virtual;
    return board->dispatching ? board->dispatch_clock : clock_at(board, monotonic_ns());
}

uint32_t board_clock(struct node *node) {
    return (uint32_t)virtual_clock((struct virtual_board *)node);
}
