// SPDX-License-Identifier: Apache-2.0
// A stop group's trigger by a sensor whose readings are numbers. For tasks and commands only.
#ifndef OBJECTS_TRIGGER_ANALOG_H
#define OBJECTS_TRIGGER_ANALOG_H

#include "core/node.h"

struct trigger_analog;

// The trigger OID, or null after a shutdown.
struct trigger_analog *trigger_analog_find(struct node *node, uint32_t oid);
// The sensor has a READING, made at CLOCK.
void trigger_analog_add(struct node *node, struct trigger_analog *trigger, uint32_t clock, int32_t reading);
// The sensor could not be read at CLOCK, for a reason of its own: number ERROR.
void trigger_analog_fail(struct node *node, struct trigger_analog *trigger, uint32_t clock, uint8_t error);

#endif
