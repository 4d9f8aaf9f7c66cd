// SPDX-License-Identifier: Apache-2.0
// What the configuration commands need of core/memory.c; objects use core/node.h.
#ifndef CORE_MEMORY_H
#define CORE_MEMORY_H

#include "core/node.h"

// Makes room for COUNT objects; a shutdown when that was done before.
void oids_allocate(struct node *node, uint8_t count);
// Turns what is left of the arena into at most config.move_count slots.
void moves_allocate(struct node *node);

#endif
