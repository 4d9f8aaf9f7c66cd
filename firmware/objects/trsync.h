// SPDX-License-Identifier: Apache-2.0
// Stop groups: whatever joined is stopped at once when the group triggers or its time-out expires.
#ifndef OBJECTS_TRSYNC_H
#define OBJECTS_TRSYNC_H

#include "core/node.h"

struct trsync;

// Embedded in whoever wants to be stopped. STOP runs once, in interrupt context.
struct trsync_signal {
    struct trsync_signal *next;
    void (*stop)(struct node *node, struct trsync_signal *signal);
    bool joined;
};

// Finds the group OID. NULL after a shutdown.
struct trsync *trsync_lookup(struct node *node, uint8_t oid);
// Joins until the group triggers; at once when it did since trsync_start. Joining twice is a shutdown.
void trsync_join(struct node *node, struct trsync *group, struct trsync_signal *signal);
// Interrupt context: stops all members. Only the first trigger after trsync_start acts.
void trsync_fire(struct node *node, struct trsync *group, uint8_t reason);

#endif
