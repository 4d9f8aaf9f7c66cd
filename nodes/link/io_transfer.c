// SPDX-License-Identifier: Apache-2.0
// Bytes and frames through the file descriptor of a bus.
#include <errno.h>
#include <string.h>
#include <unistd.h>

#include "nodes/link/io_bus.h"

// SocketCAN answers ENOBUFS while the interface's queue is full, but calls the socket writable: only time
// helps. A full frame lasts 111 µs and more.
#define NO_BUFFERS_NS 300000ULL

enum { FRAME = sizeof(struct can_frame), DATA_MAX = 8, DATA_ID = 0x100, FROM_NODE = 1 };

// -------------------------------------------------------------------------------------------- for Python

void io_notify(struct io_bus *bus) {
    uint64_t one = 1;
    // An eventfd holds 2^64-2 such ones: the write cannot fail, and one is enough until it is read.
    if (!bus->noticed && write(bus->notice_fd, &one, sizeof one) == sizeof one)
        bus->noticed = 1;
}

static void push(struct io_bus *bus, struct io_ring *ring, const struct io_event *event, uint64_t *dropped,
                 uint64_t *most) {
    if (ring->count == ring->size) {
        ring->first = (ring->first + 1) % ring->size;
        ring->count--;
        ++*dropped;
    }
    ring->events[(ring->first + ring->count++) % ring->size] = *event;
    if (ring->count > *most)
        *most = ring->count;
    io_notify(bus);
}

void io_end(struct io_bus *bus, int cause) {
    if (bus->ended)
        return;
    bus->ended = bus->ended_pending = 1;
    bus->ended_errno = cause;
    io_notify(bus);
}

// ------------------------------------------------------------------------------------------------- reading

void io_deliver(struct io_bus *bus, struct io_link *node, const uint8_t *data, size_t size, uint64_t now) {
    struct link_response response;
    while (link_receive(&node->link, &data, &size, now, &response)) {
        struct io_event event = {.notice = IO_RESPONSE, .size = response.size, .link = node->number};
        event.sent_ns = response.sent_ns;
        event.received_ns = response.received_ns;
        memcpy(event.content, response.content, response.size);
        push(bus, &bus->responses, &event, &bus->stats.responses_dropped, &bus->stats.responses_max);
    }
}

static void receive_frame(struct io_bus *bus, const struct can_frame *frame, uint64_t now) {
    bus->stats.frames_received++;
    if (frame->can_dlc > DATA_MAX) {
        bus->stats.frames_malformed++;
        return;
    }
    uint32_t nodeid = (frame->can_id - DATA_ID) / 2;
    int data = frame->can_id >= DATA_ID && nodeid < 256 && (frame->can_id & 1) == FROM_NODE;
    if (data && bus->by_nodeid[nodeid]) {
        io_deliver(bus, bus->by_nodeid[nodeid], frame->data, frame->can_dlc, now);
        return;
    }
    bus->stats.frames_unclaimed++;
    struct io_event event = {.notice = IO_FRAME, .size = frame->can_dlc, .can_id = frame->can_id};
    event.received_ns = now;
    memcpy(event.content, frame->data, frame->can_dlc);
    push(bus, &bus->unclaimed, &event, &bus->stats.frames_dropped, &bus->stats.unclaimed_max);
}

static void receive_bytes(struct io_bus *bus, size_t size, uint64_t now) {
    bus->stats.bytes_received += size;
    if (bus->kind == IO_BYTES) {
        if (bus->link_count)
            io_deliver(bus, bus->links[0], bus->in, size, now);
        return;
    }
    struct can_frame frame;
    size_t at = 0, used = bus->in_used + size;
    for (; used - at >= FRAME; at += FRAME) {
        memcpy(&frame, bus->in + at, FRAME);
        receive_frame(bus, &frame, now);
    }
    bus->in_used = used - at;
    if (bus->kind == IO_CAN_PACKET && bus->in_used) {
        bus->stats.frames_malformed++; // a packet is a frame, and this one is not
        bus->in_used = 0;
    }
    memmove(bus->in, bus->in + at, bus->in_used);
}

void io_read_all(struct io_bus *bus, uint64_t now) {
    // Bounded, so that a flood cannot keep the thread from sending; what is left wakes it again at once.
    // Enough for all that waits after a stall of the host, lest an acknowledgement in there count as late.
    for (int rounds = 0; rounds < 1024 && !bus->ended; rounds++) {
        size_t room = bus->kind == IO_CAN_PACKET ? FRAME : sizeof bus->in - bus->in_used;
        ssize_t size = read(bus->fd, bus->in + bus->in_used, room);
        if (size > 0) {
            receive_bytes(bus, (size_t)size, now);
            if (bus->kind != IO_CAN_PACKET && (size_t)size < room)
                return; // a stream gave less than there was room for: it is empty
        } else if (size == 0) {
            io_end(bus, 0);
        } else if (errno == EAGAIN || errno == EWOULDBLOCK) {
            return;
        } else if (errno != EINTR) {
            io_end(bus, errno);
        }
    }
}

// ------------------------------------------------------------------------------------------------- writing

static void put_frame(struct io_bus *bus, uint32_t can_id, const uint8_t *data, size_t size) {
    struct can_frame frame = {.can_id = can_id, .can_dlc = (uint8_t)size};
    memcpy(frame.data, data, size);
    memcpy(bus->out + bus->out_size, &frame, FRAME);
    bus->out_size += FRAME;
    bus->stats.frames_sent++;
}

static size_t frames_left(const struct io_bus *bus) {
    return (sizeof bus->out - bus->out_size) / FRAME;
}

// Cuts blocks of one link into frames; a frame holds the end of one block and the start of the next where
// both are ready and no other link is due earlier.
static void fill_from(struct io_bus *bus, struct io_link *node, uint64_t now) {
    uint8_t bytes[DATA_MAX - 1 + LINK_WIRE_MAX];
    size_t used = 0;
    uint32_t can_id = DATA_ID + 2u * node->nodeid;
    while (frames_left(bus) * DATA_MAX >= sizeof bytes) {
        size_t size = link_next_block(&node->link, now, bytes + used);
        io_served(bus, node);
        used += size;
        size_t at = 0;
        for (; used - at >= DATA_MAX; at += DATA_MAX)
            put_frame(bus, can_id, bytes + at, DATA_MAX);
        used -= at;
        memmove(bytes, bytes + at, used);
        if (size == 0 || io_next_link(bus, now) != node)
            break;
    }
    if (used)
        put_frame(bus, can_id, bytes, used);
}

// Makes the next bytes for the kernel; returns 0 when there is nothing to send now.
static int fill(struct io_bus *bus, uint64_t now) {
    bus->out_at = bus->out_size = 0;
    struct io_link *node;
    if (bus->kind == IO_BYTES) {
        node = bus->link_count ? bus->links[0] : NULL;
        while (node && sizeof bus->out - bus->out_size >= LINK_WIRE_MAX) {
            size_t size = link_next_block(&node->link, now, bus->out + bus->out_size);
            if (size == 0)
                break;
            bus->out_size += size;
        }
        return bus->out_size > 0;
    }
    while (bus->admin_count && frames_left(bus)) {
        const struct can_frame *frame = &bus->admin[bus->admin_first];
        put_frame(bus, frame->can_id, frame->data, frame->can_dlc);
        bus->admin_first = (bus->admin_first + 1) % IO_ADMIN_MAX;
        bus->admin_count--;
    }
    if (bus->out_size == 0 && (node = io_next_link(bus, now)) != NULL)
        fill_from(bus, node, now);
    return bus->out_size > 0;
}

// Hands bytes to the kernel; returns 0 when it takes no more.
static int flush(struct io_bus *bus, uint64_t now) {
    while (bus->out_at < bus->out_size) {
        size_t size = bus->kind == IO_CAN_PACKET ? FRAME : bus->out_size - bus->out_at;
        ssize_t done = write(bus->fd, bus->out + bus->out_at, size);
        if (done > 0) {
            bus->out_at += (size_t)done;
            bus->stats.bytes_sent += (uint64_t)done;
            continue;
        }
        if (done < 0 && errno == EINTR)
            continue;
        if (done < 0 && errno == ENOBUFS)
            bus->retry_ns = now + NO_BUFFERS_NS;
        else if (done == 0 || errno == EAGAIN || errno == EWOULDBLOCK)
            bus->kernel_full = 1;
        else
            io_end(bus, errno);
        bus->stats.waits++;
        return 0;
    }
    return 1;
}

void io_write_all(struct io_bus *bus, uint64_t now) {
    if (bus->ended || bus->kernel_full || now < bus->retry_ns)
        return;
    bus->retry_ns = 0;
    while (flush(bus, now) && fill(bus, now))
        ;
}
