// SPDX-License-Identifier: Apache-2.0
// Messages: a list of typed arguments, one after the other.
#include "wire.h"

#include <string.h>

static uint32_t clip(uint8_t type, uint32_t value) {
    switch (type) {
    case WIRE_U16:
        return (uint16_t)value;
    case WIRE_I16:
        return (uint32_t)(int32_t)(int16_t)(uint16_t)value;
    case WIRE_U8:
        return (uint8_t)value;
    default:
        return value;
    }
}

size_t wire_pack(const uint8_t *types, size_t count, const struct wire_arg *args, uint8_t *out, size_t room) {
    size_t used = 0;
    for (size_t i = 0; i < count; i++) {
        uint8_t number[WIRE_VLQ_MAX];
        size_t size = wire_vlq_encode(number, (int32_t)args[i].value);
        size_t bytes = types[i] == WIRE_BYTES ? args[i].value : 0;
        if (size > room - used || bytes > room - used - size)
            return 0;
        memcpy(out + used, number, size);
        used += size;
        if (bytes) {
            memcpy(out + used, args[i].data, bytes);
            used += bytes;
        }
    }
    return used;
}

int wire_unpack(const uint8_t *types, size_t count, const uint8_t **at, const uint8_t *end,
                struct wire_arg *args) {
    const uint8_t *p = *at;
    for (size_t i = 0; i < count; i++) {
        uint32_t value;
        if (wire_vlq_decode(&p, end, &value))
            return -1;
        args[i].value = clip(types[i], value);
        args[i].data = NULL;
        if (types[i] != WIRE_BYTES)
            continue;
        if (value > (size_t)(end - p))
            return -1;
        args[i].data = p;
        p += value;
    }
    *at = p;
    return 0;
}
