// SPDX-License-Identifier: Apache-2.0
// Random numbers: every component has its own generator, derived from the world's seed, its kind and its
// number, so that adding a component does not change the others.
#ifndef WORLD_CHANCE_H
#define WORLD_CHANCE_H

#include <math.h>
#include <stdint.h>

enum chance_kind { CHANCE_WIRE = 1, CHANCE_NODE, CHANCE_PORT, CHANCE_UART, CHANCE_PYTHON };

struct chance {
    uint64_t state;
};

// splitmix64: any seed is suitable.
static inline uint64_t chance_bits(struct chance *chance) {
    uint64_t z = chance->state += UINT64_C(0x9E3779B97F4A7C15);
    z = (z ^ z >> 30) * UINT64_C(0xBF58476D1CE4E5B9);
    z = (z ^ z >> 27) * UINT64_C(0x94D049BB133111EB);
    return z ^ z >> 31;
}

static inline struct chance chance_of(uint64_t seed, enum chance_kind kind, uint32_t number) {
    struct chance chance = {seed};
    chance.state = chance_bits(&chance) ^ (uint64_t)kind << 32;
    chance.state = chance_bits(&chance) ^ number;
    chance.state = chance_bits(&chance);
    return chance;
}

// 0 <= result < 1, in steps of 2^-53.
static inline double chance_fraction(struct chance *chance) {
    return (double)(chance_bits(chance) >> 11) * 0x1p-53;
}

// Draws no number for probability 0.
static inline int chance_happens(struct chance *chance, double probability) {
    return probability > 0 && chance_fraction(chance) < probability;
}

// 0 <= result < LIMIT.
static inline uint64_t chance_below(struct chance *chance, uint64_t limit) {
    return limit ? (uint64_t)(chance_fraction(chance) * (double)limit) : 0;
}

// min + exponentially distributed with MEAN, at most MAX in all.
static inline uint64_t chance_latency(struct chance *chance, uint64_t min_ns, uint64_t mean_ns,
                                      uint64_t max_ns) {
    if (mean_ns == 0)
        return min_ns;
    double more = -log(1.0 - chance_fraction(chance)) * (double)mean_ns;
    uint64_t total = min_ns + (uint64_t)more;
    return total < max_ns || max_ns < min_ns ? total : max_ns;
}

#endif
