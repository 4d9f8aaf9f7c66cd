// SPDX-License-Identifier: Apache-2.0
// The event queue of a simulated world, and its time.
//
// Time is true time in integer ns; it moves only from event to event. Events of one instant fire in the order
// in which they were planned, so that a run depends on its seed only.
#ifndef WORLD_AGENDA_H
#define WORLD_AGENDA_H

#include <stddef.h>
#include <stdint.h>

#define AGENDA_NEVER UINT64_MAX
#define NS_PER_S UINT64_C(1000000000)

// Embedded in its owner; zeroed but for fire and owner before its first use.
struct event {
    uint64_t at_ns, order;
    uint32_t place; // in the heap, from 1; 0: not planned
    void (*fire)(void *owner);
    void *owner;
};

struct agenda {
    struct event **heap;
    uint32_t count, room, reserved;
    uint64_t now_ns, order, fired;
    uint64_t trace; // hash of everything that was noted
};

// Reserves memory for COUNT more events. Returns 0, or -1: no memory.
int agenda_reserve(struct agenda *agenda, uint32_t count);
void agenda_free(struct agenda *agenda);
// Plans EVENT, or changes its time. A time in the past means now.
void agenda_plan(struct agenda *agenda, struct event *event, uint64_t at_ns);
void agenda_cancel(struct agenda *agenda, struct event *event);
// Fires the next event, if it is due up to and including UNTIL_NS; returns whether it did.
int agenda_step(struct agenda *agenda, uint64_t until_ns);

static inline int event_planned(const struct event *event) {
    return event->place != 0;
}

// Adds WHAT to the trace: two runs with equal traces did the same at the same times.
static inline void agenda_note(struct agenda *agenda, uint64_t what) {
    uint64_t mixed = (agenda->trace ^ what ^ agenda->now_ns << 20) * UINT64_C(0x9E3779B97F4A7C15);
    agenda->trace = mixed ^ mixed >> 29;
}

#endif
