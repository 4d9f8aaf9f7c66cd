// SPDX-License-Identifier: Apache-2.0
// Filters of a sensor's readings: a reading minus an offset, times a scale, through a chain of second-order
// sections in fixed point. For tasks and commands only.
#ifndef OBJECTS_SOS_FILTER_H
#define OBJECTS_SOS_FILTER_H

#include "core/node.h"

struct sos_filter;

// The filter OID, or null after a shutdown.
struct sos_filter *sos_filter_find(struct node *node, uint32_t oid);
// Takes the next READING and sets OUT to what it becomes. Returns -1 where that is beyond SOS_FILTER_LIMIT:
// the filter has lost its state then.
enum { SOS_FILTER_LIMIT = 1 << 29 };
int sos_filter_apply(struct sos_filter *filter, int32_t reading, int32_t *out);

#endif
