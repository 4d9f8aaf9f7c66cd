// SPDX-License-Identifier: Apache-2.0
// fasthash64 as published by Zilong Tan, on the chip id.
#include "net/can_uuid.h"

static const uint64_t SEED = 0xA16231A7;
static const uint64_t MULTIPLIER = 0x880355f21e6d1965;

static uint64_t mix(uint64_t h) {
    h ^= h >> 23;
    h *= 0x2127599bf4325c37;
    return h ^ (h >> 47);
}

void can_uuid_from_chip_id(const uint8_t *chip_id, size_t size, uint8_t uuid[CAN_UUID_SIZE]) {
    uint64_t hash = SEED ^ (size * MULTIPLIER);
    for (size_t at = 0; at < size; at += 8) {
        uint64_t word = 0;
        for (size_t i = 0; i < 8 && at + i < size; i++)
            word |= (uint64_t)chip_id[at + i] << (8 * i);
        hash = (hash ^ mix(word)) * MULTIPLIER;
    }
    hash = mix(hash);
    for (int i = 0; i < CAN_UUID_SIZE; i++)
        uuid[i] = (uint8_t)(hash >> (8 * i));
}
