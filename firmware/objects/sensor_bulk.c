// SPDX-License-Identifier: Apache-2.0
// Messages of readings: see sensor_bulk.h.
#include "objects/sensor_bulk.h"

#include <string.h>

DECL_RESPONSE(sensor_bulk_data, "sensor_bulk_data oid=%c sequence=%hu data=%*s");
DECL_RESPONSE(sensor_bulk_state, "sensor_bulk_status oid=%c clock=%u query_ticks=%u next_sequence=%hu "
                                 "buffered=%u possible_overflows=%hu");

void sensor_bulk_reset(struct sensor_bulk *bulk) {
    bulk->sequence = bulk->possible_overflows = 0;
    bulk->size = 0;
}

static void send(struct node *node, struct sensor_bulk *bulk, uint32_t oid) {
    if (!node_can_respond(node))
        return; // with the next reading
    RESPOND(node, sensor_bulk_data, INT(oid), INT(bulk->sequence), BYTES(bulk->data, bulk->size));
    bulk->sequence++;
    bulk->size = 0;
}

void sensor_bulk_add(struct node *node, struct sensor_bulk *bulk, uint32_t oid, const uint8_t *reading,
                     uint8_t size) {
    if (bulk->size + size > SENSOR_BULK_SIZE)
        send(node, bulk, oid);
    if (bulk->size + size > SENSOR_BULK_SIZE) {
        bulk->possible_overflows++;
        return;
    }
    memcpy(bulk->data + bulk->size, reading, size);
    bulk->size = (uint8_t)(bulk->size + size);
    if (bulk->size + size > SENSOR_BULK_SIZE)
        send(node, bulk, oid);
}

void sensor_bulk_status(struct node *node, const struct sensor_bulk *bulk, uint32_t oid, uint32_t clock,
                        uint32_t query_ticks, uint32_t pending) {
    RESPOND(node, sensor_bulk_state, INT(oid), INT(clock), INT(query_ticks), INT(bulk->sequence),
            INT(bulk->size + pending), INT(bulk->possible_overflows));
}
