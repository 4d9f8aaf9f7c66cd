// SPDX-License-Identifier: Apache-2.0
// A node with one object, for a test that is the board of an object's source and asks what that wants of it.
#ifndef LONE_OBJECT_H
#define LONE_OBJECT_H

#include "boards/board.h"
#include "tests/check.h"

#include <string.h>

enum { OID = 9 };

static struct node node;
static _Alignas(16) uint8_t object[256];
static uint32_t created;

uint32_t board_irq_save(struct node *at) {
    CHECK(at == &node);
    return 0;
}

void board_irq_restore(struct node *at, uint32_t state) {
    CHECK(at == &node && !state);
}

void *oid_create(struct node *at, uint32_t oid, const struct oid_type *type, size_t size) {
    CHECK(at == &node && oid == OID && type && size <= sizeof object);
    created++;
    return memset(object, 0, sizeof object);
}

void *oid_find(struct node *at, uint32_t oid, const struct oid_type *type) {
    CHECK(at == &node && oid == OID && type);
    return object;
}

void *oid_next(const struct node *at, unsigned *oid, const struct oid_type *type) {
    CHECK(at == &node && type);
    if (*oid > OID)
        return NULL;
    *oid = OID + 1;
    return object;
}

#endif
