// SPDX-License-Identifier: Apache-2.0
// Values: base-128 numbers whose first group is sign-extended when its two top bits are set.
#include "wire.h"

enum { GROUP_BITS = 7, GROUP_MASK = 0x7F, MORE = 0x80, SIGN_BITS = 0x60, VALUE_BITS = 32 };

size_t wire_vlq_encode(uint8_t *out, int64_t value) {
    // n groups hold 32*128^(n-1) values below zero and three times as many above: the first group is negative
    // only when bits 6 and 5 are both set.
    size_t groups = 1;
    int64_t limit = 32;
    while (groups < WIRE_VLQ_MAX && (value < -limit || value >= 3 * limit)) {
        limit <<= GROUP_BITS;
        groups++;
    }
    uint32_t bits = (uint32_t)value;
    for (size_t i = 0; i < groups; i++) {
        size_t shift = GROUP_BITS * (groups - 1 - i);
        out[i] = (uint8_t)(((bits >> shift) & GROUP_MASK) | (i + 1 < groups ? MORE : 0));
    }
    return groups;
}

int wire_vlq_decode(const uint8_t **at, const uint8_t *end, uint32_t *value) {
    const uint8_t *p = *at;
    if (p >= end)
        return -1;
    uint8_t group = *p++;
    uint32_t bits = group & GROUP_MASK;
    if ((group & SIGN_BITS) == SIGN_BITS)
        bits |= ~(uint32_t)GROUP_MASK;
    while (group & MORE) {
        if (p >= end || p - *at >= WIRE_VLQ_MAX)
            return -1;
        group = *p++;
        bits = (bits << GROUP_BITS) | (group & GROUP_MASK);
    }
    *at = p;
    *value = bits;
    return 0;
}
