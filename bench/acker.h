// SPDX-License-Identifier: Apache-2.0
// The least that a link takes for a node, as fast as it can be: acknowledges blocks in order, answers a block
// whose first byte is 2 with the same content behind a 3, and naks the rest. One node id on CAN.
#ifndef BENCH_ACKER_H
#define BENCH_ACKER_H

#include <linux/can.h>
#include <string.h>
#include <unistd.h>

#include "wire/wire.h"

struct acker {
    int fd, can;
    unsigned expected;
    struct wire_scanner scanner;
    uint8_t buffer[4096], raw[4096], out[16384];
    size_t used, raw_used, out_used;
};

static inline void acker_flush(struct acker *acker) {
    size_t at = 0;
    while (at < acker->out_used) {
        ssize_t done = write(acker->fd, acker->out + at, acker->out_used - at);
        if (done <= 0)
            break;
        at += (size_t)done;
    }
    acker->out_used = 0;
}

static inline void acker_answer(struct acker *acker, uint32_t can_id, const uint8_t *content, size_t size) {
    uint8_t block[WIRE_BLOCK_MAX];
    if (size)
        memcpy(block + WIRE_HEADER, content, size);
    size_t length = wire_block_finish(block, size, acker->expected);
    if (sizeof acker->out - acker->out_used < 8 * sizeof(struct can_frame))
        acker_flush(acker);
    for (size_t at = 0; acker->can && at < length; at += 8) {
        struct can_frame frame = {.can_id = can_id + 1,
                                  .can_dlc = (uint8_t)(length - at < 8 ? length - at : 8)};
        memcpy(frame.data, block + at, frame.can_dlc);
        memcpy(acker->out + acker->out_used, &frame, sizeof frame);
        acker->out_used += sizeof frame;
    }
    if (!acker->can) {
        memcpy(acker->out + acker->out_used, block, length);
        acker->out_used += length;
    }
}

static inline void acker_take(struct acker *acker, uint32_t can_id, const uint8_t *data, size_t size) {
    memcpy(acker->buffer + acker->used, data, size);
    acker->used += size;
    size_t at = 0, skip, length;
    enum wire_scan found;
    while ((found = wire_scan(&acker->scanner, acker->buffer + at, acker->used - at, &skip, &length)) !=
           WIRE_MORE) {
        const uint8_t *block = acker->buffer + at + skip;
        at += skip + length;
        if (found == WIRE_BLOCK && (block[1] & WIRE_SEQ_MASK) == acker->expected) {
            acker->expected = (acker->expected + 1) & WIRE_SEQ_MASK;
            uint8_t content[WIRE_CONTENT_MAX];
            memcpy(content, block + WIRE_HEADER, length - WIRE_BLOCK_MIN);
            if (length > WIRE_BLOCK_MIN && content[0] == 2) {
                content[0] = 3;
                acker_answer(acker, can_id, content, length - WIRE_BLOCK_MIN);
            }
        }
        acker_answer(acker, can_id, NULL, 0);
    }
    at += skip;
    acker->used -= at;
    memmove(acker->buffer, acker->buffer + at, acker->used);
}

// Serves until the other end closes.
static inline void acker_run(struct acker *acker) {
    ssize_t size;
    while ((size = read(acker->fd, acker->raw + acker->raw_used, 2048)) > 0) {
        acker->raw_used += (size_t)size;
        size_t at = 0;
        if (!acker->can) {
            acker_take(acker, 0, acker->raw, acker->raw_used);
            at = acker->raw_used;
        }
        for (struct can_frame frame; acker->raw_used - at >= sizeof frame; at += sizeof frame) {
            memcpy(&frame, acker->raw + at, sizeof frame);
            acker_take(acker, frame.can_id, frame.data, frame.can_dlc);
        }
        acker->raw_used -= at;
        memmove(acker->raw, acker->raw + at, acker->raw_used);
        acker_flush(acker);
    }
}

#endif
