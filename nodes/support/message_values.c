// SPDX-License-Identifier: Apache-2.0
#include "nodes/support/message_values.h"

size_t message_values(const uint8_t *types, size_t count, const uint8_t *content, size_t size, size_t start,
                      struct message_value *values) {
    const uint8_t *at = content + start;
    for (size_t i = 0; i < count; i++) {
        struct wire_arg arg;
        if (wire_unpack(types + i, 1, &at, content + size, &arg))
            return 0;
        values[i] = (struct message_value){arg.value, arg.data ? (uint32_t)(arg.data - content) : 0};
    }
    return (size_t)(at - content);
}
