// SPDX-License-Identifier: Apache-2.0
// Transmission: blocks of links split into frames, admin frames before them.
#include <string.h>

#include "nodes/link/io/io_bus.h"

// Destination of the next bytes for the wire.
struct outlet {
    uint8_t *out;
    size_t size, room;
    uint64_t left; // frames (a serial line: bytes) for which the kernel's queue has room
};

static int fits_frame(const struct outlet *outlet) {
    return outlet->room - outlet->size >= IO_FRAME_SIZE;
}

static int has_room(const struct outlet *outlet) {
    return fits_frame(outlet) && outlet->left > 0;
}

static void spend(struct io_bus *bus, enum link_class kind, uint32_t bits) {
    schedule_sent(&bus->schedule, kind, bits);
    bus->allowed = schedule_allowed(&bus->schedule);
}

static uint32_t put_frame(struct io_bus *bus, struct outlet *outlet, enum link_class kind, uint32_t can_id,
                          const uint8_t *data, size_t size) {
    struct can_frame frame = {.can_id = can_id, .can_dlc = (uint8_t)size};
    memcpy(frame.data, data, size);
    memcpy(outlet->out + outlet->size, &frame, IO_FRAME_SIZE);
    outlet->size += IO_FRAME_SIZE;
    outlet->left -= outlet->left > 0; // a stop needs none
    uint32_t bits = io_frame_bits(bus, can_id, data, size);
    bus->stats.frames_sent++;
    spend(bus, kind, bits);
    return bits;
}

// They are few and bounded: no budget. A stop does not wait for room either, nor for the end of a pause: what
// waits in the kernel is an estimate, from a bit rate that a node reports.
static void send_admin(struct io_bus *bus, struct outlet *outlet) {
    while (bus->admin_count) {
        const struct can_frame *frame = &bus->admin[bus->admin_first];
        if (io_is_stop(frame->can_id) ? !fits_frame(outlet) : !has_room(outlet))
            return;
        put_frame(bus, outlet, LINK_CONTROL, frame->can_id, frame->data, frame->can_dlc);
        bus->admin_first = (bus->admin_first + 1) % IO_ADMIN_MAX;
        bus->admin_count--;
    }
}

static void count_sent(struct io_bus *bus, struct io_link *node, uint64_t frames, uint32_t bits) {
    struct io_flow *flow = &node->flows[node->cut_offer.kind];
    flow->frames += frames;
    flow->bits += bits;
    if (node->cut_offer.kind == LINK_MOTION)
        bus->motion_bits += bits;
}

// Writes the next block of NODE, as offered, to OUT; returns its size.
static size_t take_block(struct io_bus *bus, struct io_link *node, const struct link_offer *offer,
                         uint64_t now, uint8_t *out) {
    uint64_t content = node->link.motion_content;
    size_t size = link_next_block(&node->link, now, bus->allowed, out);
    node->changed = 1;
    node->cut_offer = *offer;
    node->flows[offer->kind].blocks++;
    bus->motion_content += (double)(node->link.motion_content - content);
    io_served(bus, node);
    return size;
}

// Appends NODE's next block to the remainder of the previous one; returns 0 when it has none, or when another
// node is due earlier.
static int append_block(struct io_bus *bus, struct io_link *node, uint64_t now) {
    struct link_offer offer;
    if (io_next_link(bus, now, bus->allowed, node, &offer) != node)
        return 0;
    size_t left = node->cut_size - node->cut_at;
    memmove(node->cut, node->cut + node->cut_at, left);
    node->cut_size = left + take_block(bus, node, &offer, now, node->cut + left);
    node->cut_at = 0;
    return 1;
}

// Splits blocks of one link into frames while no other link is due earlier. A frame contains the end of one
// block and the start of the next where both are ready.
static void send_from(struct io_bus *bus, struct io_link *node, struct outlet *outlet, uint64_t now) {
    uint32_t can_id = IO_DATA_ID + 2u * node->nodeid;
    while (has_room(outlet)) {
        size_t left = node->cut_size - node->cut_at;
        if (left < IO_DATA_MAX && append_block(bus, node, now))
            continue;
        size_t size = left < IO_DATA_MAX ? left : IO_DATA_MAX;
        if (size) {
            uint32_t bits = put_frame(bus, outlet, (enum link_class)node->cut_offer.kind, can_id,
                                      node->cut + node->cut_at, size);
            count_sent(bus, node, 1, bits);
        }
        node->cut_at += size;
        if (size < IO_DATA_MAX)
            return;
    }
}

static void send_frames(struct io_bus *bus, struct outlet *outlet, uint64_t now) {
    struct link_offer offer;
    send_admin(bus, outlet);
    while (has_room(outlet)) {
        struct io_link *node = io_next_link(bus, now, bus->allowed, NULL, &offer);
        if (!node)
            return;
        send_from(bus, node, outlet, now);
    }
}

static void send_bytes(struct io_bus *bus, struct outlet *outlet, uint64_t now) {
    struct io_link *node = bus->link_count ? bus->links[0] : NULL;
    while (node && outlet->left && outlet->room - outlet->size >= LINK_WIRE_MAX) {
        struct link_offer offer;
        if (!link_next_offer(&node->link, now, bus->allowed, &offer))
            return;
        size_t size = take_block(bus, node, &offer, now, outlet->out + outlet->size);
        outlet->size += size;
        outlet->left -= size < outlet->left ? size : outlet->left;
        uint32_t bits = io_serial_bits(bus, size);
        spend(bus, (enum link_class)node->cut_offer.kind, bits);
        count_sent(bus, node, 0, bits);
    }
}

// Returns when delayed data may be sent: when the kernel's queue is shorter, or the budget has grown.
static void note_holds(struct io_bus *bus, const struct outlet *outlet, uint64_t now) {
    struct link_offer offer;
    bus->hold_ns = UINT64_MAX;
    schedule_held(&bus->schedule, 0);
    if (outlet->left == 0 && (bus->admin_count || io_next_link(bus, now, bus->allowed, NULL, &offer))) {
        bus->hold_ns = schedule_room_at(&bus->schedule);
        bus->stats.queue_waits++;
    }
    if (bus->allowed == LINK_ALL || !io_next_link(bus, now, LINK_ALL, NULL, &offer))
        return;
    for (int kind = LINK_MOTION; kind < LINK_CLASSES; kind++) {
        uint64_t opens_ns = schedule_opens_at(&bus->schedule, (enum link_class)kind);
        if (opens_ns > now && opens_ns < bus->hold_ns) {
            bus->hold_ns = opens_ns;
            schedule_held(&bus->schedule, 1);
        }
    }
}

// Returns since when the oldest transmission of any node is unacknowledged.
static uint64_t unanswered_since(const struct io_bus *bus) {
    uint64_t oldest_ns = UINT64_MAX;
    for (size_t i = 0; i < bus->link_count; i++) {
        const struct link *link = &bus->links[i]->link;
        uint64_t since_ns = link->state == LINK_LOST ? UINT64_MAX : link_unanswered_since(link);
        oldest_ns = since_ns < oldest_ns ? since_ns : oldest_ns;
    }
    return oldest_ns;
}

size_t io_next(struct io_bus *bus, uint64_t now, uint64_t queued, uint8_t *out, size_t room) {
    if (bus->ended)
        return 0;
    schedule_advance(&bus->schedule, now);
    bus->allowed = schedule_allowed(&bus->schedule);
    struct outlet outlet = {.out = out, .room = room, .left = schedule_room(&bus->schedule, queued)};
    if (schedule_pause(&bus->schedule, unanswered_since(bus)))
        outlet.left = 0;
    if (bus->kind == IO_BYTES)
        send_bytes(bus, &outlet, now);
    else
        send_frames(bus, &outlet, now);
    bus->stats.bytes_sent += outlet.size;
    if (bus->schedule.queue_frames && !bus->schedule.pause_ns) {
        uint64_t waiting = bus->schedule.queue_frames - outlet.left;
        bus->stats.queued_max = waiting > bus->stats.queued_max ? waiting : bus->stats.queued_max;
    }
    if (outlet.size == 0) { // the end of a round
        note_holds(bus, &outlet, now);
        io_publish(bus);
    }
    return outlet.size;
}
