// SPDX-License-Identifier: Apache-2.0
// sources: firmware/objects/mt.c
// MT's receiver under the sanitizers: any words in any order leave a receiver that stays within its buffers,
// keeps only whole tables, and takes the next sound transmission; the same of bytes and of a polled register.
// Rounds are the same in each run.
#include "objects/mt.h"
#include "tests/check.h"

#include <string.h>

#define ESC 0x80000000u
#define LIT 0x80000001u

enum { ROUNDS = 3000, WORDS = 400, CAPACITY_MAX = 9, GAP = 50 };

static uint64_t state;

static uint32_t below(uint32_t limit) {
    uint64_t z = (state += 0x9E3779B97F4A7C15u);
    z = (z ^ (z >> 30)) * 0xBF58476D1CE4E5B9u;
    z = (z ^ (z >> 27)) * 0x94D049BB133111EBu;
    return (uint32_t)((z ^ (z >> 31)) % limit);
}

static uint32_t any_word(void) {
    switch (below(10)) {
    case 0:
        return ESC;
    case 1:
        return LIT;
    case 2:
        return 0x10000000u | below(4);
    case 3:
        return 0x20000000u | (below(50) ? below(2 * CAPACITY_MAX) : 0x0FFFFFFF);
    case 4:
        return 0x30000000u | below(16);
    case 5:
        return 0x40000000u | below(2);
    case 6:
        return below(0xFFFFFFFF);
    default:
        return below(4);
    }
}

// A transmission of PAIRS to axle 1; returns how many words OUT got.
static size_t transmission(const struct mt_pair *pairs, uint32_t count, uint32_t *out) {
    uint32_t sum = 0, *at = out;
    for (uint32_t i = 0; i < count; i++)
        sum += (uint32_t)pairs[i].x + (uint32_t)pairs[i].y;
    const uint32_t head[] = {ESC,
                             0x10000000u,
                             ESC,
                             0x10000001u,
                             0x40000000u | sum >> 16,
                             0x30000000u | (sum & 0xFFFF),
                             0x20000000u | count};
    memcpy(at, head, sizeof(head));
    at += sizeof(head) / sizeof(*head);
    for (uint32_t i = 0; i < 2 * count; i++) {
        uint32_t value = (uint32_t)(i % 2 ? pairs[i / 2].y : pairs[i / 2].x);
        if (value == at[-1])
            *at++ = LIT;
        *at++ = value;
    }
    *at++ = ESC;
    *at++ = ESC;
    *at++ = 0x10000000u;
    return (size_t)(at - out);
}

static uint32_t sum_of(const struct mt_receiver *receiver) {
    uint32_t sum = 0;
    for (uint32_t i = 0; i < receiver->length; i++)
        sum += (uint32_t)receiver->table[i].x + (uint32_t)receiver->table[i].y;
    return sum;
}

static void round_of(uint64_t seed) {
    state = seed;
    uint32_t capacity = 1 + below(CAPACITY_MAX);
    // Of exactly this size on the heap: what lies behind is the sanitizer's.
    struct mt_pair *buffers[2] = {calloc(capacity, sizeof(**buffers)), calloc(capacity, sizeof(**buffers))};
    struct mt_receiver receiver;
    mt_start(&receiver, 1, buffers[0], buffers[1], capacity);
    uint32_t kept = 0;
    for (unsigned i = 0; i < WORDS; i++) {
        kept += (uint32_t)mt_word(&receiver, any_word());
        CHECK_EQUAL(receiver.generation, kept);
        CHECK(receiver.length <= capacity && receiver.status <= MT_LENGTH_ERROR);
        CHECK_EQUAL(sum_of(&receiver), receiver.checksum);
    }
    struct mt_pair pairs[CAPACITY_MAX];
    for (uint32_t i = 0; i < capacity; i++)
        pairs[i] = (struct mt_pair){(int32_t)below(3), (int32_t)below(3) - 1};
    uint32_t words[2 * 2 * CAPACITY_MAX + 16];
    size_t size = transmission(pairs, capacity, words);
    // Over a register: the second of two equal words is not seen.
    struct mt_register reg = {0};
    mt_poll(&reg, below(2) ? ESC : 7);
    uint32_t seen = 0;
    for (size_t i = 0; i < size; i++)
        if (mt_poll(&reg, words[i]))
            seen += (uint32_t)mt_word(&receiver, words[i]);
    CHECK(seen >= 1); // and perhaps what waited for an ESC
    CHECK_EQUAL(receiver.status, MT_OK);
    CHECK_EQUAL(receiver.length, capacity);
    CHECK(memcmp(receiver.table, pairs, capacity * sizeof(*pairs)) == 0);
    free(buffers[0]);
    free(buffers[1]);
}

// Bytes with pauses: a pause longer than the gap begins a word, over the clock's rollover too.
static void bytes_round(uint64_t seed) {
    state = seed;
    struct mt_bytes bytes = {.gap = GAP};
    uint32_t now = UINT32_MAX - below(2000), word = 0, dropped = 0;
    for (unsigned i = 0; i < WORDS; i++) {
        uint32_t value = below(0xFFFFFFFF), size = below(4) ? MT_WORD_SIZE : 1 + below(3);
        for (uint32_t at = 0; at < size; at++) {
            int whole = mt_byte(&bytes, (uint8_t)(value >> (8 * at)), now, &word);
            CHECK_EQUAL(whole, at == MT_WORD_SIZE - 1);
            now += below(GAP + 1);
        }
        if (size == MT_WORD_SIZE)
            CHECK_EQUAL(word, value);
        else
            dropped += size;
        now += size == MT_WORD_SIZE ? below(3 * GAP) : GAP + 1;
        CHECK(bytes.dropped <= dropped && dropped - bytes.dropped < MT_WORD_SIZE);
    }
}

// What is counted stays at its highest: 2^32 values are not none.
static void counts_do_not_roll_over(void) {
    struct mt_pair buffers[2];
    struct mt_receiver receiver;
    mt_start(&receiver, 1, &buffers[0], &buffers[1], 1);
    const uint32_t words[] = {0x10000001u, 0x40000000u, 0x30000000u, 0x20000000u};
    for (size_t i = 0; i < sizeof(words) / sizeof(*words); i++)
        mt_word(&receiver, words[i]);
    receiver.values = UINT32_MAX; // so many came
    mt_word(&receiver, 0);
    mt_word(&receiver, ESC);
    CHECK_EQUAL(receiver.status, MT_LENGTH_ERROR);
}

int main(void) {
    for (uint64_t round = 1; round <= ROUNDS; round++) {
        round_of(round);
        bytes_round(round);
    }
    counts_do_not_roll_over();
    return 0;
}
