// SPDX-License-Identifier: Apache-2.0
// See can_bits.h. ISO 11898-1: stuffing acts from the start bit to the last bit of the checksum.
#include "nodes/support/can_bits.h"

enum {
    CRC_BITS = 15,
    CRC_POLYNOMIAL = 0x4599,
    // checksum delimiter, acknowledge slot and delimiter, end of frame, interframe space
    UNSTUFFED_BITS = 1 + 2 + 7 + 3,
    RUN_MAX = 5,
};

struct bit_writer {
    uint32_t crc;
    uint32_t bits;   // so far, stuff bits included
    uint32_t level;  // of the last one
    uint32_t run;    // number of bits with this level so far
    uint8_t *levels; // destination of the levels, or null
};

static void count(struct bit_writer *writer, uint32_t bit) {
    if (writer->levels)
        writer->levels[writer->bits] = (uint8_t)bit;
    writer->bits++;
}

static void put_bit(struct bit_writer *writer, uint32_t bit) {
    count(writer, bit);
    writer->run = bit == writer->level ? writer->run + 1 : 1;
    writer->level = bit;
    if (writer->run == RUN_MAX) {
        // The stuff bit begins the next run.
        writer->run = 1;
        writer->level = !bit;
        count(writer, writer->level);
    }
}

static void put(struct bit_writer *writer, uint32_t value, uint32_t width) {
    while (width-- > 0) {
        uint32_t bit = value >> width & 1;
        uint32_t feedback = bit ^ writer->crc >> (CRC_BITS - 1);
        writer->crc = (writer->crc << 1 & ((1U << CRC_BITS) - 1)) ^ (feedback ? CRC_POLYNOMIAL : 0);
        put_bit(writer, bit);
    }
}

static void put_id(struct bit_writer *writer, uint32_t id, uint32_t kind) {
    uint32_t remote = kind & CAN_BITS_REMOTE ? 1 : 0;
    if (kind & CAN_BITS_EXTENDED) {
        put(writer, id >> 18 & 0x7ff, 11);
        put(writer, 3, 2); // substitute remote request, extended format
        put(writer, id & 0x3ffff, 18);
        put(writer, remote << 2, 3); // remote request, two reserved
    } else {
        put(writer, id & 0x7ff, 11);
        put(writer, remote << 2, 3); // remote request, base format, reserved
    }
}

static uint32_t write(uint32_t id, uint32_t kind, uint32_t length, const uint8_t *data, uint8_t *levels) {
    struct bit_writer writer = {.level = 1,
                                .levels = levels}; // the idle bus is recessive, its run does not count
    put(&writer, 0, 1);                            // start of frame
    put_id(&writer, id, kind);
    put(&writer, length, 4);
    for (uint32_t i = 0; i < length && !(kind & CAN_BITS_REMOTE); i++)
        put(&writer, data[i], 8);
    for (uint32_t crc = writer.crc, left = CRC_BITS; left-- > 0;)
        put_bit(&writer, crc >> left & 1);
    return writer.bits;
}

uint32_t can_frame_bits(uint32_t id, uint32_t length, const uint8_t *data) {
    return write(id, 0, length, data, 0) + UNSTUFFED_BITS;
}

uint32_t can_any_frame_bits(uint32_t id, uint32_t kind, uint32_t length, const uint8_t *data) {
    return write(id, kind, length, data, 0) + UNSTUFFED_BITS;
}

uint32_t can_frame_levels(uint32_t id, uint32_t length, const uint8_t *data, uint8_t *levels) {
    return write(id, 0, length, data, levels);
}
