// SPDX-License-Identifier: Apache-2.0
// What goes to the wire: blocks of links cut into frames, admin frames before them.
#include <string.h>

#include "nodes/link/io_bus.h"

// Where the next bytes for the wire go.
struct outlet {
    uint8_t *out;
    size_t size, room;
};

static int has_room(const struct outlet *outlet) {
    return outlet->room - outlet->size >= IO_FRAME_SIZE;
}

static void put_frame(struct io_bus *bus, struct outlet *outlet, uint32_t can_id, const uint8_t *data,
                      size_t size) {
    struct can_frame frame = {.can_id = can_id, .can_dlc = (uint8_t)size};
    memcpy(frame.data, data, size);
    memcpy(outlet->out + outlet->size, &frame, IO_FRAME_SIZE);
    outlet->size += IO_FRAME_SIZE;
    bus->stats.frames_sent++;
}

static void send_admin(struct io_bus *bus, struct outlet *outlet) {
    while (bus->admin_count && has_room(outlet)) {
        const struct can_frame *frame = &bus->admin[bus->admin_first];
        put_frame(bus, outlet, frame->can_id, frame->data, frame->can_dlc);
        bus->admin_first = (bus->admin_first + 1) % IO_ADMIN_MAX;
        bus->admin_count--;
    }
}

// Puts NODE's next block behind what is left to cut of the one before; returns 0 when it has none.
static int append_block(struct io_bus *bus, struct io_link *node, uint64_t now) {
    size_t left = node->cut_size - node->cut_at;
    memmove(node->cut, node->cut + node->cut_at, left);
    size_t size = link_next_block(&node->link, now, node->cut + left);
    node->cut_at = 0;
    node->cut_size = left + size;
    io_served(bus, node);
    return size > 0;
}

// Cuts blocks of one link into frames while no other link is due earlier. A frame holds the end of one block
// and the start of the next where both are ready.
static void send_from(struct io_bus *bus, struct io_link *node, struct outlet *outlet, uint64_t now) {
    uint32_t can_id = IO_DATA_ID + 2u * node->nodeid;
    bus->cutting = node;
    while (has_room(outlet)) {
        size_t left = node->cut_size - node->cut_at;
        if (left < IO_DATA_MAX && io_next_link(bus, now) == node && append_block(bus, node, now))
            continue;
        size_t size = left < IO_DATA_MAX ? left : IO_DATA_MAX;
        if (size)
            put_frame(bus, outlet, can_id, node->cut + node->cut_at, size);
        node->cut_at += size;
        if (size < IO_DATA_MAX) {
            bus->cutting = NULL;
            return;
        }
    }
}

static void send_bytes(struct io_bus *bus, struct outlet *outlet, uint64_t now) {
    struct io_link *node = bus->link_count ? bus->links[0] : NULL;
    while (node && outlet->room - outlet->size >= LINK_WIRE_MAX) {
        size_t size = link_next_block(&node->link, now, outlet->out + outlet->size);
        if (size == 0)
            return;
        outlet->size += size;
    }
}

size_t io_next(struct io_bus *bus, uint64_t now, uint64_t queued, uint8_t *out, size_t room) {
    (void)queued;
    struct outlet outlet = {.out = out, .room = room};
    if (bus->ended)
        return 0;
    if (bus->kind == IO_BYTES) {
        send_bytes(bus, &outlet, now);
    } else {
        send_admin(bus, &outlet);
        struct io_link *node;
        while (has_room(&outlet) && (node = bus->cutting ? bus->cutting : io_next_link(bus, now)) != NULL)
            send_from(bus, node, &outlet, now);
    }
    bus->stats.bytes_sent += outlet.size;
    return outlet.size;
}
