// SPDX-License-Identifier: Apache-2.0
// Parameters of messages as Python reads them: numbers without pointers, in one call.
#ifndef MESSAGE_VALUES_H
#define MESSAGE_VALUES_H

#include "firmware/wire/wire.h"

// cffi: begin
// One parameter: its number, or (WIRE_BYTES) how many bytes it has and where in the content they begin.
struct message_value {
    uint32_t number;
    uint32_t at;
};

// Reads COUNT (at least 1) parameters of TYPES from START on in the SIZE bytes of CONTENT. Returns the offset
// of their end, or 0 on short input.
size_t message_values(const uint8_t *types, size_t count, const uint8_t *content, size_t size, size_t start,
                      struct message_value *values);
// cffi: end

#endif
