// SPDX-License-Identifier: Apache-2.0
// Stop groups: what has to stop joins one; a trigger, a time-out or a shutdown stops all members at once.
#ifndef OBJECTS_TRSYNC_H
#define OBJECTS_TRSYNC_H

#include "core/node.h"

struct trsync;

// Embedded by the owner; STOP runs once, in interrupt context, and the membership ends with it.
struct trsync_member {
    struct trsync_member *next;
    void (*stop)(struct node *node, struct trsync_member *member); // null: it is in no trsync
};

// The trsync OID, or null after a shutdown.
struct trsync *trsync_find(struct node *node, uint32_t oid);
// Interrupts must be off. Joining while it is in this trsync or another is a shutdown; a trsync that already
// triggered stops the member at once.
void trsync_join(struct node *node, struct trsync *trsync, struct trsync_member *member,
                 void (*stop)(struct node *node, struct trsync_member *member));
// Stops all members if nothing did before, and tells the trsync's group, here and on the bus. Interrupts must
// be off.
void trsync_trigger(struct node *node, struct trsync *trsync, uint8_t reason);
// Another node triggered GROUP: triggers every trsync of it that is armed, which tells nobody else. Interrupt
// context.
void trsync_trigger_group(struct node *node, uint8_t group, uint8_t reason);

#endif
