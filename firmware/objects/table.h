// SPDX-License-Identifier: Apache-2.0
// Tables that the host downloads by MT (objects/mt.h): each table is an object with an axle's number. The
// words come in broadcast frames on CAN, through the link, or through a register that is polled; wherever
// they come from, all tables of the node hear them.
//
// A sound transmission replaces the table that is kept; which of the kept tables is in use is another matter:
// `table_activate` says from which clock on, and it does nothing while the table's stepper moves.
#ifndef OBJECTS_TABLE_H
#define OBJECTS_TABLE_H

#include "core/node.h"

// A frame of tables came: one or two words. Interrupt context.
void table_receive_frame(struct node *node, const uint8_t *data, size_t size);

#endif
