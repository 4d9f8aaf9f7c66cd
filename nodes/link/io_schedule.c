// SPDX-License-Identifier: Apache-2.0
// Whose turn it is on a bus. The seam for a scheduler that budgets bits: it decides here and nowhere else.
#include "nodes/link/io_bus.h"

// Earliest deadline first; repeats and control are due at once. Among equals the turn goes round.
struct io_link *io_next_link(struct io_bus *bus, uint64_t now) {
    uint64_t earliest_ns = UINT64_MAX;
    size_t chosen = IO_LINKS_MAX;
    for (size_t i = 0; i < bus->link_count; i++) {
        size_t at = (bus->turn + i) % bus->link_count;
        uint64_t due_ns = link_next_due(&bus->links[at]->link, now);
        if (due_ns < earliest_ns) {
            earliest_ns = due_ns;
            chosen = at;
        }
    }
    if (chosen == IO_LINKS_MAX)
        return NULL;
    bus->turn = chosen + 1;
    return bus->links[chosen];
}
