// SPDX-License-Identifier: Apache-2.0
// The byte ring behind link_queue: records may wrap around its end.
#include "nodes/link/core/queue.h"

#include "nodes/link/core/batch.h"

enum { STAMP = sizeof(uint64_t), FIRST_ROOM = 4096 };

void link_queue_init(struct link_queue *queue, uint8_t *memory, size_t size, int stamped) {
    *queue = (struct link_queue){
        .memory = memory,
        .size = size,
        .room = size < FIRST_ROOM ? size : FIRST_ROOM,
        .stamped = stamped ? 1 : 0,
    };
}

static size_t header_of(const struct link_queue *queue) {
    return queue->stamped ? BATCH_HEADER + STAMP : BATCH_HEADER;
}

// Where what was put AT this count of bytes begins in memory.
static size_t start_of(const struct link_queue *queue, uint64_t at) {
    return (size_t)(at & (queue->room - 1));
}

static size_t up_to_the_end(const struct link_queue *queue, size_t start, size_t size) {
    size_t left = (size_t)queue->room - start;
    return size < left ? size : left;
}

static void copy_in(struct link_queue *queue, uint64_t at, const uint8_t *from, size_t size) {
    size_t start = start_of(queue, at), first = up_to_the_end(queue, start, size);
    memcpy(queue->memory + start, from, first);
    memcpy(queue->memory, from + first, size - first);
}

static void copy_out(const struct link_queue *queue, uint64_t at, uint8_t *to, size_t size) {
    size_t start = start_of(queue, at), first = up_to_the_end(queue, start, size);
    memcpy(to, queue->memory + start, first);
    memcpy(to + first, queue->memory, size - first);
}

// Doubles the room. What lies in every other stretch of that length has its place in the new half.
static void grow(struct link_queue *queue) {
    uint64_t room = queue->room, stretch = queue->tail & ~(room - 1);
    uint64_t from = stretch, to = queue->tail;
    if (!(stretch & room)) { // the one before it moves, as far as it is queued
        from = queue->head;
        to = stretch;
    }
    if (from < to) {
        size_t start = start_of(queue, from);
        memcpy(queue->memory + room + start, queue->memory + start, (size_t)(to - from));
    }
    queue->room = 2 * room;
}

int link_queue_put(struct link_queue *queue, const uint8_t *batch, size_t size, uint64_t count) {
    if (size > queue->size - link_queue_bytes(queue))
        return 0;
    while (size > queue->room - link_queue_bytes(queue))
        grow(queue);
    copy_in(queue, queue->tail, batch, size);
    queue->tail += size;
    queue->commands += count;
    if (queue->commands > queue->commands_max)
        queue->commands_max = queue->commands;
    if (link_queue_bytes(queue) > queue->bytes_max)
        queue->bytes_max = link_queue_bytes(queue);
    return 1;
}

int link_queue_put_stamped(struct link_queue *queue, const struct link_command *command,
                           const uint8_t *payload) {
    uint8_t record[BATCH_HEADER + STAMP + UINT8_MAX];
    memcpy(record, &command->min_clock, sizeof command->min_clock);
    memcpy(record + 8, &command->req_clock, sizeof command->req_clock);
    record[16] = command->size;
    memcpy(record + BATCH_HEADER, &command->queued_ns, STAMP);
    memcpy(record + BATCH_HEADER + STAMP, payload, command->size);
    return link_queue_put(queue, record, header_of(queue) + command->size, 1);
}

uint64_t link_queue_peek(const struct link_queue *queue, uint64_t at, struct link_command *out) {
    uint8_t header[BATCH_HEADER + STAMP]; // a fixed size, for speed: executed for every command
    size_t start = start_of(queue, at);
    if (queue->room - start >= sizeof header)
        memcpy(header, queue->memory + start, sizeof header);
    else
        copy_out(queue, at, header, sizeof header);
    memcpy(&out->min_clock, header, sizeof out->min_clock);
    memcpy(&out->req_clock, header + 8, sizeof out->req_clock);
    out->size = header[16];
    out->queued_ns = 0;
    if (queue->stamped)
        memcpy(&out->queued_ns, header + BATCH_HEADER, STAMP);
    return at + header_of(queue) + out->size;
}

void link_queue_payload(const struct link_queue *queue, uint64_t at, const struct link_command *command,
                        uint8_t *out) {
    copy_out(queue, at + header_of(queue), out, command->size);
}

void link_queue_drop(struct link_queue *queue, uint64_t at, uint64_t count) {
    queue->head = at;
    queue->commands -= count;
}
