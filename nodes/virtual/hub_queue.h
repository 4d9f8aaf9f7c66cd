// SPDX-License-Identifier: Apache-2.0
// Records, and the queues of a client that hold them. Only for hub.c.
#ifndef NODES_VIRTUAL_HUB_QUEUE_H
#define NODES_VIRTUAL_HUB_QUEUE_H

#include "nodes/virtual/hub.h"

#include <string.h>

enum { ID_MAX = 0x7FF, DATA_MAX = 8, LENGTH_AT = 4, DATA_AT = 8, OUTPUT_BYTES = HUB_OUTPUT * HUB_RECORD };

_Static_assert((HUB_INPUT & (HUB_INPUT - 1)) == 0, "free-running indices need a power of two");
_Static_assert((OUTPUT_BYTES & (OUTPUT_BYTES - 1)) == 0, "free-running indices need a power of two");

// ------------------------------------------------------------------------------------------------- records

static inline uint32_t record_id(const uint8_t *record) {
    uint32_t id; // flags stand above the 11 bits
    memcpy(&id, record, sizeof(id));
    return id;
}

static inline bool is_frame(const uint8_t *record) {
    return record_id(record) <= ID_MAX && record[LENGTH_AT] <= DATA_MAX;
}

// Copies the fields of a frame and zeros elsewhere, never other contents of the sender's memory.
static inline void copy_frame(uint8_t *out, const uint8_t *record) {
    memset(out, 0, HUB_RECORD);
    memcpy(out, record, LENGTH_AT + 1);
    memcpy(out + DATA_AT, record + DATA_AT, record[LENGTH_AT]);
}

// ------------------------------------------------------------------------------------------------- queues

static inline uint32_t input_count(const struct hub_client *client) {
    return client->input_tail - client->input_head;
}

static inline const struct hub_frame *input_head(const struct hub_client *client) {
    return &client->input[client->input_head % HUB_INPUT];
}

static inline bool output_full(const struct hub_client *client) {
    return client->state == HUB_PRESENT &&
           client->output_tail - client->output_head > OUTPUT_BYTES - HUB_RECORD;
}

static inline void output_push(struct hub_client *client, const uint8_t *record) {
    // The tail is always at the start of a record, so the end of the ring splits none.
    memcpy(client->output + client->output_tail % OUTPUT_BYTES, record, HUB_RECORD);
    client->output_tail += HUB_RECORD;
    client->counters.received++;
}

#endif
