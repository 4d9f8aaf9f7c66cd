// SPDX-License-Identifier: Apache-2.0
// Rings that use only as much of their memory as they need: most machines never fill them, and memory that
// was never touched takes no room. Elements are numbered; number i lies at place i modulo the room in use, a
// power of two.
#ifndef MOTION_GROWING_RING_H
#define MOTION_GROWING_RING_H

#include <stddef.h>
#include <stdint.h>
#include <string.h>

enum { RING_FIRST_ROOM = 64 };

// Makes sure that the full ring's next element, number TO, has a place: doubles ROOM, at most to MAX, when
// all of it is taken by the elements from number FROM on, each of SIZE bytes. Pointers to elements are void
// then.
static inline void ring_make_room(void *ring, size_t size, uint64_t from, uint64_t to, uint32_t *room,
                                  uint32_t max) {
    if (to - from < *room || *room >= max)
        return;
    uint8_t *at = ring;
    for (uint64_t i = from; i < to; i++) {
        const size_t place = (size_t)(i & (*room - 1));
        if (i & *room) // of each two that share a place in turn, this one's new place is in the other half
            memcpy(at + (place + *room) * size, at + place * size, size);
    }
    *room *= 2;
}

#endif
