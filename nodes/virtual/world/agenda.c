// SPDX-License-Identifier: Apache-2.0
// A binary heap, see agenda.h.
#include "nodes/virtual/world/agenda.h"

#include <stdlib.h>

int agenda_reserve(struct agenda *agenda, uint32_t count) {
    uint32_t wanted = agenda->reserved + count + 1; // places count from 1
    if (wanted > agenda->room) {
        uint32_t room = wanted * 2;
        struct event **heap = realloc(agenda->heap, room * sizeof(*heap));
        if (!heap)
            return -1;
        agenda->heap = heap;
        agenda->room = room;
    }
    agenda->reserved += count;
    return 0;
}

void agenda_free(struct agenda *agenda) {
    free(agenda->heap);
    agenda->heap = NULL;
    agenda->count = agenda->room = agenda->reserved = 0;
}

static int before(const struct event *a, const struct event *b) {
    return a->at_ns < b->at_ns || (a->at_ns == b->at_ns && a->order < b->order);
}

static void put(struct agenda *agenda, struct event *event, uint32_t place) {
    agenda->heap[place] = event;
    event->place = place;
}

static void rise(struct agenda *agenda, struct event *event, uint32_t place) {
    while (place > 1 && before(event, agenda->heap[place / 2])) {
        put(agenda, agenda->heap[place / 2], place);
        place /= 2;
    }
    put(agenda, event, place);
}

static void sink(struct agenda *agenda, struct event *event, uint32_t place) {
    for (;;) {
        uint32_t child = 2 * place;
        if (child > agenda->count)
            break;
        if (child < agenda->count && before(agenda->heap[child + 1], agenda->heap[child]))
            child++;
        if (!before(agenda->heap[child], event))
            break;
        put(agenda, agenda->heap[child], place);
        place = child;
    }
    put(agenda, event, place);
}

void agenda_plan(struct agenda *agenda, struct event *event, uint64_t at_ns) {
    event->at_ns = at_ns > agenda->now_ns ? at_ns : agenda->now_ns;
    event->order = agenda->order++;
    uint32_t place = event->place ? event->place : ++agenda->count;
    if (place > 1 && before(event, agenda->heap[place / 2]))
        rise(agenda, event, place);
    else
        sink(agenda, event, place);
}

void agenda_cancel(struct agenda *agenda, struct event *event) {
    uint32_t place = event->place;
    if (!place)
        return;
    event->place = 0;
    struct event *last = agenda->heap[agenda->count--];
    if (last == event)
        return;
    if (place > 1 && before(last, agenda->heap[place / 2]))
        rise(agenda, last, place);
    else
        sink(agenda, last, place);
}

int agenda_step(struct agenda *agenda, uint64_t until_ns) {
    if (agenda->count == 0 || agenda->heap[1]->at_ns > until_ns)
        return 0;
    struct event *event = agenda->heap[1];
    agenda->now_ns = event->at_ns;
    agenda->fired++;
    agenda_cancel(agenda, event);
    event->fire(event->owner);
    return 1;
}
