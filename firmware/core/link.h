// SPDX-License-Identifier: Apache-2.0
// What the core needs of its own link; transports use core/node.h.
#ifndef CORE_LINK_H
#define CORE_LINK_H

#include "core/node.h"

// Completes a block (content already at block + WIRE_HEADER) with the expected sequence and queues it.
// A block that does not fit is dropped and counted: acks are cumulative, and queries are asked again. Holding
// commands back instead would also hold back an emergency stop.
void link_send(struct node *node, uint8_t *block, size_t content_length);

#endif
