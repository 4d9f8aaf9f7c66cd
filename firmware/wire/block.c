// SPDX-License-Identifier: Apache-2.0
// Blocks: framing, checksum and resynchronisation of a byte stream.
#include "wire.h"

#include <string.h>

enum { AT_LENGTH = 0, AT_SEQUENCE = 1 };

uint16_t wire_crc16(const uint8_t *data, size_t length) {
    // The byte-wise form of the reflected polynomial 0x1021: no table to keep in a small chip's flash.
    uint16_t crc = 0xFFFF;
    for (size_t i = 0; i < length; i++) {
        uint8_t mixed = (uint8_t)(data[i] ^ (crc & 0xFF));
        mixed ^= (uint8_t)(mixed << 4);
        crc = (uint16_t)((((unsigned)mixed << 8) | (crc >> 8)) ^ (mixed >> 4) ^ ((unsigned)mixed << 3));
    }
    return crc;
}

size_t wire_block_finish(uint8_t *block, size_t content_length, unsigned sequence) {
    size_t length = content_length + WIRE_BLOCK_MIN;
    block[AT_LENGTH] = (uint8_t)length;
    block[AT_SEQUENCE] = (uint8_t)(WIRE_SEQ_MARK | (sequence & WIRE_SEQ_MASK));
    uint16_t crc = wire_crc16(block, length - WIRE_TRAILER);
    block[length - 3] = (uint8_t)(crc >> 8);
    block[length - 2] = (uint8_t)crc;
    block[length - 1] = WIRE_SYNC;
    return length;
}

static int block_is_sound(const uint8_t *block, size_t length) {
    uint16_t crc = (uint16_t)(((unsigned)block[length - 3] << 8) | block[length - 2]);
    return block[length - 1] == WIRE_SYNC && crc == wire_crc16(block, length - WIRE_TRAILER);
}

// Drops a damaged stretch: to behind the next sync byte, or all of it when there is none yet.
static size_t hunt(struct wire_scanner *scanner, const uint8_t *data, size_t size) {
    const uint8_t *sync = memchr(data, WIRE_SYNC, size);
    scanner->hunting = sync == NULL;
    return sync ? (size_t)(sync - data) + 1 : size;
}

enum wire_scan wire_scan(struct wire_scanner *scanner, const uint8_t *data, size_t size, size_t *skip,
                         size_t *length) {
    size_t at = scanner->hunting && size ? hunt(scanner, data, size) : 0;
    while (at < size && data[at] == WIRE_SYNC) // extra sync bytes in front of a block are legal
        at++;
    *skip = at;
    *length = 0;
    if (at == size)
        return WIRE_MORE;
    size_t wanted = data[at + AT_LENGTH];
    int bad = wanted < WIRE_BLOCK_MIN || wanted > WIRE_BLOCK_MAX;
    if (!bad && size - at > AT_SEQUENCE)
        bad = (data[at + AT_SEQUENCE] & ~WIRE_SEQ_MASK) != WIRE_SEQ_MARK;
    if (!bad && size - at < wanted)
        return WIRE_MORE;
    if (!bad && block_is_sound(data + at, wanted)) {
        *length = wanted;
        return WIRE_BLOCK;
    }
    *skip = at + hunt(scanner, data + at, size - at);
    return WIRE_LOST;
}
