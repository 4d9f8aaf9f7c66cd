// SPDX-License-Identifier: Apache-2.0
// Order of the links of a bus, and the cost of a frame.
#include "nodes/link/io/io_bus.h"
#include "nodes/support/can_bits.h"

enum { BITS_PER_BYTE = 10 }; // of a serial line: start, eight, stop

// Earliest deadline first over all nodes; equals take turns.
struct io_link *io_next_link(const struct io_bus *bus, uint64_t now, unsigned allowed,
                             const struct io_link *ending, struct link_offer *best) {
    struct io_link *chosen = NULL;
    for (size_t i = 0; i < bus->link_count; i++) {
        struct io_link *node = bus->links[(bus->turn + i) % bus->link_count];
        struct link_offer offer;
        if (node->cut_at < node->cut_size && node != ending)
            offer = node->cut_offer;
        else if (!link_next_offer(&node->link, now, allowed, &offer))
            continue;
        if (!chosen || schedule_before(&offer, best, now)) {
            chosen = node;
            *best = offer;
        }
    }
    return chosen;
}

void io_served(struct io_bus *bus, const struct io_link *node) {
    for (size_t i = 0; i < bus->link_count; i++)
        if (bus->links[i] == node)
            bus->turn = i + 1;
}

uint32_t io_frame_bits(const struct io_bus *bus, uint32_t can_id, const uint8_t *data, size_t size) {
    return bus->schedule.bitrate ? can_frame_bits(can_id & CAN_SFF_MASK, (uint32_t)size, data) : 0;
}

uint32_t io_serial_bits(const struct io_bus *bus, size_t size) {
    return bus->schedule.bitrate ? (uint32_t)size * BITS_PER_BYTE : 0;
}
