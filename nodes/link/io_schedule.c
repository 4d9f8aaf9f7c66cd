// SPDX-License-Identifier: Apache-2.0
// Whose turn it is on a bus. The seam for a scheduler that budgets bits: it decides here and nowhere else.
#include "nodes/link/io_bus.h"

// Earliest deadline first; repeats and control are due at once. Among equals the turn goes round.
struct io_link *io_next_link(const struct io_bus *bus, uint64_t now) {
    uint64_t earliest_ns = UINT64_MAX;
    struct io_link *chosen = NULL;
    for (size_t i = 0; i < bus->link_count; i++) {
        struct io_link *node = bus->links[(bus->turn + i) % bus->link_count];
        uint64_t due_ns = link_next_due(&node->link, now);
        if (due_ns < earliest_ns) {
            earliest_ns = due_ns;
            chosen = node;
        }
    }
    return chosen;
}

void io_served(struct io_bus *bus, const struct io_link *node) {
    for (size_t i = 0; i < bus->link_count; i++)
        if (bus->links[i] == node)
            bus->turn = i + 1;
}
