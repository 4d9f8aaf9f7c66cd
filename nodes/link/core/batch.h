// SPDX-License-Identifier: Apache-2.0
// Batches of timed commands: motion passes a node's commands to the link in one call from Python.
//
// A batch is a byte string of records, in the order in which the node must receive them:
//     <u64 min_clock> <u64 req_clock> <u8 size> <size bytes: one encoded command>
// in the host's byte order, unaligned. Clocks are the node's ticks in 64 bits. min_clock: the node's queue
// has no room before; the command is not sent earlier (0: at once). req_clock: when the command is due;
// queues are ordered by it.
#ifndef LINK_BATCH_H
#define LINK_BATCH_H

#include <stdint.h>
#include <string.h>

enum {
    BATCH_REQ_CLOCK = 8,
    BATCH_SIZE = 16,
    BATCH_HEADER = 17
}; // offsets of the fields; the payload follows

struct batch_record {
    uint64_t min_clock, req_clock;
    uint8_t size;
    const uint8_t *payload;
};

// Reads the record at AT, where ROOM bytes are available. Returns its total length, or 0 when it is
// incomplete.
static inline size_t batch_read(const uint8_t *at, size_t room, struct batch_record *out) {
    if (room < BATCH_HEADER || room - BATCH_HEADER < at[BATCH_SIZE])
        return 0;
    memcpy(&out->min_clock, at, sizeof out->min_clock);
    memcpy(&out->req_clock, at + BATCH_REQ_CLOCK, sizeof out->req_clock);
    out->size = at[BATCH_SIZE];
    out->payload = at + BATCH_HEADER;
    return (size_t)BATCH_HEADER + out->size;
}

// Writes a record whose PAYLOAD is SIZE bytes; the caller provides the room. Returns its total length.
static inline size_t batch_write(uint8_t *at, uint64_t min_clock, uint64_t req_clock, const uint8_t *payload,
                                 uint8_t size) {
    memcpy(at, &min_clock, sizeof min_clock);
    memcpy(at + BATCH_REQ_CLOCK, &req_clock, sizeof req_clock);
    at[BATCH_SIZE] = size;
    memcpy(at + BATCH_HEADER, payload, size);
    return (size_t)BATCH_HEADER + size;
}

#endif
