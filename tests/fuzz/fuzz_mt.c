// SPDX-License-Identifier: Apache-2.0
// Any bytes as MT's receiver hears them: through the stream of bytes with its pauses, and through a polled
// register. Whatever comes, the receiver stays in its buffers, what it keeps is what it was told, and the
// next sound transmission arrives.
//
// Input: capacity; then records of a kind and up to seven bytes: a pause, bytes, or a word by a table of
// MT's own words, so that an input needs few bytes to get far.
#include "objects/mt.h"

#include <stdio.h>
#include <stdlib.h>
#include <string.h>

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size);

enum { GAP = 100, CAPACITY_MAX = 8 };

static void must(int condition, const char *what) {
    if (condition)
        return;
    fprintf(stderr, "not true: %s\n", what);
    abort();
}

static void hear(struct mt_receiver *receiver, uint32_t word) {
    uint32_t before = receiver->generation;
    int kept = mt_word(receiver, word);
    must(receiver->generation == before + (uint32_t)kept,
         "a table that is kept counts, and nothing else does");
    must(receiver->status <= MT_LENGTH_ERROR && receiver->length <= receiver->capacity, "status and length");
    if (!kept)
        return;
    uint32_t sum = 0, digest = 0;
    for (uint32_t i = 0; i < receiver->length; i++) {
        sum += (uint32_t)receiver->table[i].x + (uint32_t)receiver->table[i].y;
        digest = digest * MT_DIGEST_FACTOR + (uint32_t)receiver->table[i].x;
        digest = digest * MT_DIGEST_FACTOR + (uint32_t)receiver->table[i].y;
    }
    must(receiver->status == MT_OK && sum == receiver->checksum && digest == receiver->digest,
         "what is kept");
}

static uint32_t word_of(uint8_t kind, uint8_t value) {
    static const uint32_t words[] = {0x80000000u, 0x80000001u, 0x10000000u, 0x20000000u,
                                     0x30000000u, 0x40000000u, 0xFFFFFFF0u, 0};
    uint32_t word = words[kind % 8];
    return word >> 31 && kind % 8 < 2 ? word : word + value % 16;
}

static void arrives(struct mt_receiver *receiver) {
    static const uint32_t sound[] = {0x80000000u, 0x10000000u, 0x80000000u, 0x10000004u,
                                     0x40000000u, 0x30000003u, 0x20000001u, 1,
                                     2,           0x80000000u, 0x80000000u, 0x10000000u};
    for (size_t i = 0; i < sizeof(sound) / sizeof(*sound); i++)
        hear(receiver, sound[i]);
    must(receiver->status == MT_OK && receiver->length == 1, "the next one arrives");
    must(receiver->table[0].x == 1 && receiver->table[0].y == 2, "the next one is kept");
}

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size) {
    if (size < 1)
        return 0;
    uint32_t capacity = 1 + data[0] % CAPACITY_MAX;
    struct mt_pair *buffers[2] = {calloc(capacity, sizeof(**buffers)), calloc(capacity, sizeof(**buffers))};
    struct mt_receiver receiver;
    mt_start(&receiver, 3, buffers[0], buffers[1], capacity);
    struct mt_bytes bytes = {.gap = GAP};
    struct mt_register reg = {0};
    uint32_t now = UINT32_MAX - 2 * GAP, word;
    for (size_t at = 1; at + 1 < size; at += 2) {
        uint8_t kind = data[at], value = data[at + 1];
        if (kind % 4 == 0)
            now += value;
        else if (kind % 4 == 1 && mt_byte(&bytes, value, now, &word))
            hear(&receiver, word);
        else if (kind % 4 == 2 && mt_poll(&reg, word_of(kind / 4, value)))
            hear(&receiver, reg.last);
        else if (kind % 4 == 3)
            hear(&receiver, word_of(kind / 4, value));
    }
    arrives(&receiver);
    free(buffers[0]);
    free(buffers[1]);
    return 0;
}
