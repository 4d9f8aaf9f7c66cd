// SPDX-License-Identifier: Apache-2.0
// Readings of a fast sensor, collected into messages of SENSOR_BULK_SIZE bytes at most. All of this is for
// tasks and commands: a sensor that is read in interrupt context has to hand its readings to its task first.
#ifndef OBJECTS_SENSOR_BULK_H
#define OBJECTS_SENSOR_BULK_H

#include "core/node.h"

enum { SENSOR_BULK_SIZE = 48 }; // a multiple of readings of 1, 2, 3, 4, 6, 8 and 12 bytes

// Embedded by the owner; zero-initialised is empty.
struct sensor_bulk {
    uint16_t sequence;           // of the next message
    uint16_t possible_overflows; // readings that were lost, here or in the sensor
    uint8_t size;                // bytes in data
    uint8_t data[SENSOR_BULK_SIZE];
};

// Empties BULK and begins with sequence 0.
void sensor_bulk_reset(struct sensor_bulk *bulk);
// Adds a reading and sends the message that it completes. A reading for which there is no room is dropped and
// counted as an overflow.
void sensor_bulk_add(struct node *node, struct sensor_bulk *bulk, uint32_t oid, const uint8_t *reading,
                     uint8_t size);
// Answers the host's question for the state: PENDING bytes are still in the sensor at CLOCK, the answer took
// QUERY_TICKS.
void sensor_bulk_status(struct node *node, const struct sensor_bulk *bulk, uint32_t oid, uint32_t clock,
                        uint32_t query_ticks, uint32_t pending);

#endif
