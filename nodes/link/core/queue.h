// SPDX-License-Identifier: Apache-2.0
// A bounded queue of commands in the format of batch.h, in memory of the owner.
#ifndef LINK_QUEUE_H
#define LINK_QUEUE_H

#include <stddef.h>
#include <stdint.h>

#include "wire/wire.h"

// cffi: begin
// Positions count bytes since the start and never wrap; SIZE is a power of two. The ring goes around the
// first ROOM bytes of the memory, a power of two as well, which doubles when a record does not fit: most
// queues stay short, and memory that was never touched takes no room.
struct link_queue {
    uint8_t *memory;
    uint64_t size, room, head, tail;
    uint64_t stamped;                 // records contain, after the header, when they were queued
    uint64_t commands;                // records in the queue
    uint64_t bytes_max, commands_max; // largest numbers so far
};
// cffi: end

// One record at the front of a queue; PAYLOAD is read separately.
struct link_command {
    uint64_t min_clock, req_clock;
    uint64_t queued_ns; // of a stamped queue, else 0
    uint8_t size;
};

void link_queue_init(struct link_queue *queue, uint8_t *memory, size_t size, int stamped);

// Appends COUNT complete records, SIZE bytes in total; returns 0 and changes nothing when they do not fit.
int link_queue_put(struct link_queue *queue, const uint8_t *batch, size_t size, uint64_t count);

// Appends one command to a stamped queue; returns as link_queue_put.
int link_queue_put_stamped(struct link_queue *queue, const struct link_command *command,
                           const uint8_t *payload);

// Reads the record at position AT (head <= AT < tail) and returns the next position.
uint64_t link_queue_peek(const struct link_queue *queue, uint64_t at, struct link_command *out);

// Copies the payload of the record at position AT, of which COMMAND was read.
void link_queue_payload(const struct link_queue *queue, uint64_t at, const struct link_command *command,
                        uint8_t *out);

// Drops the COUNT records in front of position AT.
void link_queue_drop(struct link_queue *queue, uint64_t at, uint64_t count);

static inline uint64_t link_queue_bytes(const struct link_queue *queue) {
    return queue->tail - queue->head;
}

#endif
