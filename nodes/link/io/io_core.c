// SPDX-License-Identifier: Apache-2.0
// Creation and end of a bus's core, its timers, and events for Python.
#include "nodes/link/io/io_core.h"

#include <stdlib.h>

#include "nodes/link/io/io_bus.h"

// ------------------------------------------------------------------------------------------- start and end

static int make_ring(struct io_ring *ring, size_t size) {
    ring->events = calloc(size, sizeof *ring->events);
    ring->size = size;
    return ring->events != NULL;
}

struct io_bus *io_new(enum io_kind kind, const struct io_settings *settings, const struct io_driver *driver,
                      void *context) {
    struct io_bus *bus = calloc(1, sizeof *bus);
    if (!bus)
        return NULL;
    bus->kind = kind;
    bus->driver = *driver;
    bus->hold_ns = bus->notice_ns = UINT64_MAX;
    bus->context = context;
    bus->settings = *settings;
    schedule_init(&bus->schedule, settings->bitrate, settings->ceiling, settings->queue_frames,
                  kind == IO_BYTES, driver->now(context));
    if (make_ring(&bus->responses, IO_RESPONSES_MAX) && make_ring(&bus->unclaimed, IO_FRAMES_MAX))
        return bus;
    io_free(bus);
    return NULL;
}

void io_free(struct io_bus *bus) {
    for (size_t i = 0; i < bus->link_count; i++)
        free(bus->links[i]);
    free(bus->responses.events);
    free(bus->unclaimed.events);
    free(bus);
}

void io_set_bitrate(struct io_bus *bus, uint32_t bitrate) {
    io_lock(bus);
    if (bitrate != bus->schedule.bitrate)
        schedule_init(&bus->schedule, bitrate, bus->settings.ceiling, bus->settings.queue_frames,
                      bus->kind == IO_BYTES, bus->driver.now(bus->context));
    io_unlock(bus);
}

int io_bounds_queue(const struct io_bus *bus) {
    return bus->schedule.queue_frames != 0;
}

void io_lock(struct io_bus *bus) {
    bus->driver.lock(bus->context);
}

void io_unlock(struct io_bus *bus) {
    bus->driver.unlock(bus->context);
}

void io_end(struct io_bus *bus, int cause) {
    if (bus->ended)
        return;
    bus->ended = bus->ended_pending = 1;
    bus->ended_errno = cause;
    io_notify(bus);
}

int io_ended(const struct io_bus *bus) {
    return bus->ended;
}

int32_t io_end_cause(struct io_bus *bus) {
    io_lock(bus);
    int32_t cause = bus->ended_errno;
    io_unlock(bus);
    return cause;
}

void io_count_wait(struct io_bus *bus) {
    bus->stats.waits++;
}

void io_count_wakeup(struct io_bus *bus) {
    bus->stats.wakeups++;
}

// ---------------------------------------------------------------------------------------------------- time

void io_handle_time(struct io_bus *bus, uint64_t now) {
    for (size_t i = 0; i < bus->link_count && !bus->ended; i++) {
        struct io_link *node = bus->links[i];
        uint64_t timeouts = node->link.stats.timeouts;
        io_deliver(bus, node, NULL, 0, now);
        link_handle_timer(&node->link, now);
        node->changed |= node->link.stats.timeouts != timeouts;
    }
    if (bus->hold_ns <= now) // io_next() follows, or the driver waits for another event
        bus->hold_ns = UINT64_MAX;
    if (bus->notice_ns <= now)
        io_notify(bus);
    io_publish(bus);
    io_note_states(bus);
}

uint64_t io_deadline(const struct io_bus *bus, uint64_t now) {
    uint64_t at_ns = bus->ended ? UINT64_MAX : bus->hold_ns;
    for (size_t i = 0; i < bus->link_count && !bus->ended; i++) {
        uint64_t link_ns = link_deadline(&bus->links[i]->link, now, bus->allowed);
        at_ns = link_ns < at_ns ? link_ns : at_ns;
    }
    return bus->notice_ns < at_ns ? bus->notice_ns : at_ns;
}

int io_may_stay_unread(const struct io_bus *bus, uint64_t now) {
    if (bus->ended || bus->admin_count || bus->hold_ns <= now || bus->hold_ns - now > IO_UNREAD_NS)
        return 0;
    for (size_t i = 0; i < bus->link_count; i++)
        if (bus->links[i]->in_a_hurry || link_awaits_answer(&bus->links[i]->link))
            return 0;
    return 1;
}

// ----------------------------------------------------------------------------------------------- for Python

static void set_notice(struct io_bus *bus, uint64_t at_ns) {
    __atomic_store_n(&bus->notice_ns, at_ns, __ATOMIC_RELAXED);
}

void io_notify(struct io_bus *bus) {
    if (bus->noticed)
        return;
    bus->noticed = 1;
    set_notice(bus, UINT64_MAX);
    bus->driver.notify(bus->context);
}

void io_notify_by(struct io_bus *bus, uint64_t now, uint64_t wait_ns) {
    if (wait_ns == 0)
        io_notify(bus);
    else if (!bus->noticed && now + wait_ns < bus->notice_ns)
        set_notice(bus, now + wait_ns);
}

int io_waits(const struct io_bus *bus) {
    return __atomic_load_n(&bus->notice_ns, __ATOMIC_RELAXED) != UINT64_MAX;
}

void io_push(struct io_ring *ring, const struct io_event *event, uint64_t *dropped, uint64_t *most) {
    if (ring->count == ring->size) {
        ring->first = (ring->first + 1) % ring->size;
        ring->count--;
        ++*dropped;
    }
    ring->events[(ring->first + ring->count++) % ring->size] = *event;
    if (ring->count > *most)
        *most = ring->count;
}

void io_note_states(struct io_bus *bus) {
    for (size_t i = 0; i < bus->link_count; i++) {
        struct io_link *node = bus->links[i];
        if (node->link.state == LINK_LOST && !node->lost_reported) {
            node->lost_reported = node->lost_pending = 1;
            io_notify(bus);
        }
        if (node->link.silences != node->silences) {
            node->silences = node->link.silences;
            node->silent_pending = 1;
            io_notify(bus);
        }
        if (node->watch_drained && link_pending(&node->link) == 0) {
            node->watch_drained = 0;
            node->drained_pending = 1;
            io_notify(bus);
        }
    }
}

static size_t take_ring(struct io_ring *ring, struct io_event *out, size_t room) {
    size_t taken = 0;
    for (; taken < room && ring->count; taken++, ring->count--) {
        out[taken] = ring->events[ring->first];
        ring->first = (ring->first + 1) % ring->size;
    }
    if (!ring->count)
        ring->first = 0; // it goes through no more of its memory than was ever taken
    return taken;
}

// Returns how much of ROOM is for RING: half in a flood, whose end what comes behind it does not wait for.
static size_t share(const struct io_ring *ring, size_t room) {
    return ring->count > ring->size / 2 ? room / 2 : room;
}

// Moves a pending notice to OUT, if there is room; returns the number of events.
static size_t take_notice(uint8_t *pending, struct io_event *out, size_t room, struct io_event event) {
    if (!*pending || room == 0)
        return 0;
    *pending = 0;
    *out = event;
    return 1;
}

static size_t take_notices(struct io_bus *bus, struct io_event *out, size_t room) {
    size_t taken = 0;
    for (size_t i = 0; i < bus->link_count; i++) {
        struct io_link *node = bus->links[i];
        struct io_event drained = {.notice = IO_DRAINED, .link = node->number};
        struct io_event silent = {.notice = IO_SILENT, .link = node->number};
        struct io_event lost = {.notice = IO_LOST, .link = node->number, .value = (int32_t)node->link.cause};
        taken += take_notice(&node->drained_pending, out + taken, room - taken, drained);
        taken += take_notice(&node->silent_pending, out + taken, room - taken, silent);
        taken += take_notice(&node->lost_pending, out + taken, room - taken, lost);
    }
    struct io_event ended = {.notice = IO_ENDED, .value = bus->ended_errno};
    return taken + take_notice(&bus->ended_pending, out + taken, room - taken, ended);
}

size_t io_take(struct io_bus *bus, struct io_event *out, size_t room) {
    io_lock(bus);
    size_t taken = take_ring(&bus->unclaimed, out, share(&bus->unclaimed, room));
    taken += take_ring(&bus->responses, out + taken, share(&bus->responses, room - taken));
    taken += take_notices(bus, out + taken, room - taken);
    taken += take_ring(&bus->unclaimed, out + taken, room - taken);
    taken += take_ring(&bus->responses, out + taken, room - taken);
    io_publish(bus);
    if (taken < room) { // also without a notice: that of what is taken already may come late
        bus->noticed = 0;
        bus->takes++;
        set_notice(bus, UINT64_MAX);
        if (bus->driver.quiet)
            bus->driver.quiet(bus->context);
    }
    io_unlock(bus);
    return taken;
}
