// SPDX-License-Identifier: Apache-2.0
// Reception: frames from bytes, and their links.
#include <string.h>

#include "nodes/link/io/io_bus.h"

enum { FROM_NODE = 1 };

// Counts one more that waits; returns whether all that come together do.
static int completes(const struct io_bus *bus, struct io_patience *patience) {
    if (patience->takes != bus->takes)
        patience->waiting = 0;
    patience->takes = bus->takes;
    return ++patience->waiting == patience->together;
}

// How long a response may wait for others.
static uint64_t patience_with(const struct io_bus *bus, struct io_link *node,
                              const struct link_response *response) {
    for (size_t i = 0; i < IO_PATIENT_MAX && !node->in_a_hurry; i++) {
        struct io_patience *patience = &node->patience[i];
        if (patience->size && patience->size <= response->size &&
            memcmp(response->content, patience->id, patience->size) == 0)
            return completes(bus, patience) ? 0 : patience->wait_ns;
    }
    return 0;
}

void io_deliver(struct io_bus *bus, struct io_link *node, const uint8_t *data, size_t size, uint64_t now) {
    struct link_response response;
    size_t waiting = node->link.rx_used;
    node->changed |= size > 0;
    while (link_receive(&node->link, &data, &size, now, &response)) {
        struct io_event event = {.notice = IO_RESPONSE, .size = response.size, .link = node->number};
        event.sent_ns = response.sent_ns;
        event.received_ns = response.received_ns;
        memcpy(event.content, response.content, response.size);
        io_push(&bus->responses, &event, &bus->stats.responses_dropped, &bus->stats.responses_max);
        io_notify_by(bus, now, patience_with(bus, node, &response));
    }
    node->changed |=
        node->link.rx_used != waiting; // also without new bytes: an incomplete block may have been given up
}

// An acknowledgement is one frame of one empty block; what motion costs includes those.
static void deliver_frame(struct io_bus *bus, struct io_link *node, const struct can_frame *frame,
                          uint32_t bits, uint64_t now) {
    int ack = frame->can_dlc == WIRE_BLOCK_MIN && frame->data[0] == WIRE_BLOCK_MIN;
    node->received.frames++;
    node->received.bits += bits;
    schedule_received(&bus->schedule, ack ? SCHEDULE_ACKS : SCHEDULE_DATA, bits);
    io_deliver(bus, node, frame->data, frame->can_dlc, now);
}

static void receive_frame(struct io_bus *bus, const struct can_frame *frame, uint64_t now) {
    bus->stats.frames_received++;
    if (frame->can_dlc > IO_DATA_MAX) {
        bus->stats.frames_malformed++;
        return;
    }
    uint32_t bits = io_frame_bits(bus, frame->can_id, frame->data, frame->can_dlc);
    uint32_t nodeid = (frame->can_id - IO_DATA_ID) / 2;
    int data = frame->can_id >= IO_DATA_ID && nodeid < 256 && (frame->can_id & 1) == FROM_NODE;
    if (data && bus->by_nodeid[nodeid]) {
        deliver_frame(bus, bus->by_nodeid[nodeid], frame, bits, now);
        return;
    }
    bus->stats.frames_unclaimed++;
    schedule_received(&bus->schedule, frame->can_id > IO_ADMIN_LAST_ID ? SCHEDULE_WEAK : SCHEDULE_DATA, bits);
    struct io_event event = {.notice = IO_FRAME, .size = frame->can_dlc, .can_id = frame->can_id};
    event.received_ns = now;
    memcpy(event.content, frame->data, frame->can_dlc);
    io_push(&bus->unclaimed, &event, &bus->stats.frames_dropped, &bus->stats.unclaimed_max);
    io_notify(bus);
}

// The first bytes of a frame may have been received before.
static void receive_stream(struct io_bus *bus, const uint8_t *data, size_t size, uint64_t now) {
    while (bus->rest_size + size >= IO_FRAME_SIZE) {
        struct can_frame frame;
        memcpy(&frame, bus->rest, bus->rest_size);
        memcpy((uint8_t *)&frame + bus->rest_size, data, IO_FRAME_SIZE - bus->rest_size);
        data += IO_FRAME_SIZE - bus->rest_size;
        size -= IO_FRAME_SIZE - bus->rest_size;
        bus->rest_size = 0;
        receive_frame(bus, &frame, now);
    }
    memcpy(bus->rest + bus->rest_size, data, size);
    bus->rest_size += size;
}

void io_received(struct io_bus *bus, const uint8_t *data, size_t size, uint64_t now) {
    bus->stats.bytes_received += size;
    schedule_advance(&bus->schedule, now);
    if (bus->kind == IO_BYTES) {
        uint32_t bits = io_serial_bits(bus, size);
        schedule_received(&bus->schedule, SCHEDULE_DATA, bits);
        if (bus->link_count)
            io_deliver(bus, bus->links[0], data, size, now);
    } else if (bus->kind == IO_CAN_STREAM || size == IO_FRAME_SIZE) {
        receive_stream(bus, data, size, now);
    } else {
        bus->stats.frames_malformed++; // a packet has to be one frame
    }
}
