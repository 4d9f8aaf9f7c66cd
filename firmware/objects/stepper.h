// SPDX-License-Identifier: Apache-2.0
// What other objects ask of a stepper.
#ifndef OBJECTS_STEPPER_H
#define OBJECTS_STEPPER_H

#include "core/node.h"

struct stepper;

// The stepper OID, or null after a shutdown.
const struct stepper *stepper_find(struct node *node, uint32_t oid);
// Whether steps are queued or on their way.
int stepper_moves(const struct stepper *stepper);

#endif
