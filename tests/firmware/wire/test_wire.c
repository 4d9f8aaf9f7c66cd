// SPDX-License-Identifier: Apache-2.0
// sources: firmware/wire/*.c
// The wire codec against the vectors of the protocol, and on damaged streams.
#include "tests/check.h"
#include "wire/wire.h"

#include <string.h>

static void vlq_vectors(void) {
    static const struct {
        int64_t value;
        size_t size;
        uint8_t bytes[5];
    } vectors[] = {
        {0, 1, {0x00}},
        {95, 1, {0x5f}},
        {96, 2, {0x80, 0x60}},
        {-32, 1, {0x60}},
        {-33, 2, {0xff, 0x5f}},
        {12287, 2, {0xdf, 0x7f}},
        {12288, 3, {0x80, 0xe0, 0x00}},
        {-4097, 3, {0xff, 0xdf, 0x7f}},
        {1281, 2, {0x8a, 0x01}},
        {7458, 2, {0xba, 0x22}},
        {2147483647, 5, {0x87, 0xff, 0xff, 0xff, 0x7f}},
        {-2147483648LL, 5, {0x88, 0x80, 0x80, 0x80, 0x00}},
        {4294967295LL, 5, {0x8f, 0xff, 0xff, 0xff, 0x7f}},
    };
    for (size_t i = 0; i < sizeof(vectors) / sizeof(*vectors); i++) {
        uint8_t out[WIRE_VLQ_MAX];
        CHECK_EQUAL(wire_vlq_encode(out, vectors[i].value), vectors[i].size);
        CHECK(memcmp(out, vectors[i].bytes, vectors[i].size) == 0);
        const uint8_t *at = out;
        uint32_t value;
        CHECK_EQUAL(wire_vlq_decode(&at, out + vectors[i].size, &value), 0);
        CHECK_EQUAL(value, (uint32_t)vectors[i].value);
        CHECK(at == out + vectors[i].size);
        for (size_t cut = 0; cut < vectors[i].size; cut++) {
            at = out;
            CHECK_EQUAL(wire_vlq_decode(&at, out + cut, &value), -1);
            CHECK(at == out);
        }
    }
}

static void block_vectors(void) {
    CHECK_EQUAL(wire_crc16((const uint8_t *)"123456789", 9), 0x6F91);
    uint8_t block[WIRE_BLOCK_MAX];
    CHECK_EQUAL(wire_block_finish(block, 0, 0), 5);
    CHECK(memcmp(block, "\x05\x10\x9e\x81\x7e", 5) == 0);
    CHECK_EQUAL(wire_block_finish(block, 0, 31), 5);
    CHECK(memcmp(block, "\x05\x1f\x66\x76\x7e", 5) == 0);
    memcpy(block + WIRE_HEADER, "\x01\x00\x28", 3);
    CHECK_EQUAL(wire_block_finish(block, 3, 1), 8);
    CHECK(memcmp(block, "\x08\x11\x01\x00\x28\x42\x24\x7e", 8) == 0);
}

// Every prefix asks for more, the whole block is found, and syncs in front are skipped.
static void scanner_finds_blocks(void) {
    const uint8_t stream[] = {0x7e, 0x7e, 0x08, 0x11, 0x01, 0x00, 0x28, 0x42, 0x24, 0x7e, 0x05};
    struct wire_scanner scanner = {0};
    size_t skip, length;
    for (size_t n = 0; n < 10; n++)
        CHECK_EQUAL(wire_scan(&scanner, stream, n, &skip, &length), WIRE_MORE);
    CHECK_EQUAL(wire_scan(&scanner, stream, sizeof(stream), &skip, &length), WIRE_BLOCK);
    CHECK_EQUAL(skip, 2);
    CHECK_EQUAL(length, 8);
}

// One flipped bit anywhere costs that block once, and the block behind it is found again.
static void scanner_recovers(void) {
    for (size_t bit = 0; bit < 64; bit++) {
        uint8_t stream[8 + 64 + 5] = {0};
        memcpy(stream, "\x08\x11\x01\x00\x28\x42\x24\x7e", 8);
        for (size_t i = 8; i < 72; i++)
            stream[i] = WIRE_SYNC; // as much as the longest length a damaged header could ask for
        memcpy(stream + 72, "\x05\x11\x8f\x08\x7e", 5);
        stream[bit / 8] ^= (uint8_t)(1u << bit % 8);
        struct wire_scanner scanner = {0};
        size_t at = 0, losses = 0, skip, length;
        for (;;) {
            enum wire_scan scan = wire_scan(&scanner, stream + at, sizeof(stream) - at, &skip, &length);
            at += skip;
            if (scan == WIRE_BLOCK)
                break;
            CHECK(scan == WIRE_LOST);
            losses++;
        }
        CHECK_EQUAL(at, 72);
        CHECK_EQUAL(length, 5);
        CHECK(losses >= 1 && losses <= 2);
    }
}

int main(void) {
    vlq_vectors();
    block_vectors();
    scanner_finds_blocks();
    scanner_recovers();
    return 0;
}
