// SPDX-License-Identifier: Apache-2.0
// A ring that grows keeps all its elements, wherever it begins, and touches no more memory than it needs.
#include "coordinator/motion/growing_ring.h"
#include "tests/check.h"

enum { MOST = 1024 };

static uint64_t ring[MOST];

static void add(uint64_t from, uint64_t *to, uint32_t *room) {
    ring_make_room(ring, sizeof(*ring), from, *to, room, MOST);
    ring[*to & (*room - 1)] = *to;
    ++*to;
}

static void check_all(uint64_t from, uint64_t to, uint32_t room) {
    CHECK(to - from <= room);
    for (uint64_t i = from; i < to; i++)
        CHECK_EQUAL(ring[i & (room - 1)], i);
}

// From every beginning, so that elements of both halves move.
static void test_grows_from_everywhere(void) {
    for (uint64_t begin = 0; begin < 2 * MOST; begin++) {
        uint64_t to = begin;
        uint32_t room = RING_FIRST_ROOM;
        while (to - begin < MOST) {
            add(begin, &to, &room);
            check_all(to - begin > 80 ? to - 80 : begin, to, room);
        }
        CHECK_EQUAL(room, MOST);
        check_all(begin, to, room);
    }
}

static void test_stays_small_while_little_waits(void) {
    uint64_t from = 0, to = 0;
    uint32_t room = RING_FIRST_ROOM;
    for (int i = 0; i < 10 * MOST; i++) {
        add(from, &to, &room);
        if (to - from == RING_FIRST_ROOM)
            from += 1 + (uint64_t)(i % 7);
    }
    CHECK_EQUAL(room, RING_FIRST_ROOM);
    check_all(from, to, room);
    add(from, &to, &room);
    while (to - from <= RING_FIRST_ROOM)
        add(from, &to, &room);
    CHECK_EQUAL(room, 2 * RING_FIRST_ROOM);
    check_all(from, to, room);
}

int main(void) {
    test_grows_from_everywhere();
    test_stays_small_while_little_waits();
    return 0;
}
