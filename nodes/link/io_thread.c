// SPDX-License-Identifier: Apache-2.0
// The thread of a bus and the functions Python calls.
#define _GNU_SOURCE
#include "nodes/link/io_thread.h"

#include <errno.h>
#include <poll.h>
#include <stdlib.h>
#include <string.h>
#include <sys/eventfd.h>
#include <sys/prctl.h>
#include <sys/socket.h>
#include <time.h>
#include <unistd.h>

#include "nodes/link/io_bus.h"

#define NS_PER_S 1000000000ULL

static uint64_t monotonic_ns(void) {
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    return (uint64_t)now.tv_sec * NS_PER_S + (uint64_t)now.tv_nsec;
}

// -----------------------------------------------------------------------------------------------------
// thread

static void note_states(struct io_bus *bus) {
    for (size_t i = 0; i < bus->link_count; i++) {
        struct io_link *node = bus->links[i];
        if (node->link.state == LINK_LOST && !node->lost_told) {
            node->lost_told = node->lost_pending = 1;
            io_notify(bus);
        }
        if (node->watch_drained && link_pending(&node->link) == 0) {
            node->watch_drained = 0;
            node->drained_pending = 1;
            io_notify(bus);
        }
    }
}

static void handle_timers(struct io_bus *bus, uint64_t now) {
    for (size_t i = 0; i < bus->link_count && !bus->ended; i++) {
        io_deliver(bus, bus->links[i], NULL, 0, now);
        link_handle_timer(&bus->links[i]->link, now);
    }
}

static uint64_t next_deadline(const struct io_bus *bus, uint64_t now) {
    if (bus->ended)
        return UINT64_MAX;
    uint64_t at_ns = bus->retry_ns ? bus->retry_ns : UINT64_MAX;
    for (size_t i = 0; i < bus->link_count; i++) {
        uint64_t link_ns = link_deadline(&bus->links[i]->link, now);
        at_ns = link_ns < at_ns ? link_ns : at_ns;
    }
    return at_ns;
}

// Sleeps until the descriptor, a caller or time asks for work; returns what poll saw on the descriptor.
static short sleep_unlocked(struct io_bus *bus, uint64_t now) {
    struct pollfd fds[2] = {{.fd = bus->ended ? -1 : bus->fd, .events = POLLIN},
                            {.fd = bus->wake_fd, .events = POLLIN}};
    if (bus->kernel_full)
        fds[0].events |= POLLOUT;
    bus->sleep_until_ns = next_deadline(bus, now);
    uint64_t wait_ns = bus->sleep_until_ns > now ? bus->sleep_until_ns - now : 0;
    struct timespec wait = {.tv_sec = (time_t)(wait_ns / NS_PER_S), .tv_nsec = (long)(wait_ns % NS_PER_S)};
    bus->sleeping = 1;
    pthread_mutex_unlock(&bus->mutex);
    int ready = ppoll(fds, 2, bus->sleep_until_ns == UINT64_MAX ? NULL : &wait, NULL);
    uint64_t count;
    if (ready > 0 && (fds[1].revents & POLLIN) && read(bus->wake_fd, &count, sizeof count) < 0)
        ready = 0; // cannot happen: the eventfd was readable and this thread alone reads it
    pthread_mutex_lock(&bus->mutex);
    bus->sleeping = 0;
    bus->stats.wakeups++;
    return ready > 0 ? fds[0].revents : 0;
}

static void *run(void *argument) {
    struct io_bus *bus = argument;
    prctl(PR_SET_TIMERSLACK, 1000UL); // the default of 50 µs would show in every timed send
    pthread_mutex_lock(&bus->mutex);
    short seen = POLLIN;
    while (!bus->stopping) {
        uint64_t now = monotonic_ns();
        if (seen & POLLOUT)
            bus->kernel_full = 0;
        if (seen & ~POLLOUT)
            io_read_all(bus, now);
        handle_timers(bus, now);
        io_write_all(bus, now);
        note_states(bus);
        seen = sleep_unlocked(bus, now);
    }
    pthread_mutex_unlock(&bus->mutex);
    return NULL;
}

static void wake(struct io_bus *bus) {
    uint64_t one = 1;
    if (bus->sleeping && write(bus->wake_fd, &one, sizeof one) == sizeof one)
        bus->sleeping = 0;
}

// The caller sends what it queued by itself, which saves a query the thread's wake-up on its way out; the
// thread is woken only when it has to wait for something that it does not yet know of.
static void send_now(struct io_bus *bus) {
    if (!bus->sleeping)
        return; // the thread is at work, or on its way to it, and will find what was queued
    uint64_t now = monotonic_ns();
    io_write_all(bus, now);
    if (bus->ended || bus->kernel_full || next_deadline(bus, now) < bus->sleep_until_ns)
        wake(bus);
}

// ----------------------------------------------------------------------------------------------- start and
// end

static int make_ring(struct io_ring *ring, size_t size) {
    ring->events = calloc(size, sizeof *ring->events);
    ring->size = size;
    return ring->events != NULL;
}

static void forget(struct io_bus *bus) {
    for (size_t i = 0; i < bus->link_count; i++)
        free(bus->links[i]);
    free(bus->responses.events);
    free(bus->unclaimed.events);
    if (bus->wake_fd >= 0)
        close(bus->wake_fd);
    if (bus->notice_fd >= 0)
        close(bus->notice_fd);
    pthread_mutex_destroy(&bus->mutex);
    free(bus);
}

// What sits in the kernel cannot be overtaken by something more urgent. A small send buffer bounds it (the
// kernel accounts some 768 bytes for a frame or a short run of them, and doubles the figure it is given) and
// makes a full SocketCAN queue show as "not writable" instead of ENOBUFS. No socket: nothing to bound.
static void bound_kernel_queue(int fd) {
    int bytes = 8 * 768 / 2 * 2;
    setsockopt(fd, SOL_SOCKET, SO_SNDBUF, &bytes, sizeof bytes);
}

struct io_bus *io_start(int fd, enum io_kind kind) {
    struct io_bus *bus = calloc(1, sizeof *bus);
    if (!bus)
        return NULL;
    bus->fd = fd;
    bus->kind = kind;
    bus->wake_fd = eventfd(0, EFD_NONBLOCK | EFD_CLOEXEC);
    bus->notice_fd = eventfd(0, EFD_NONBLOCK | EFD_CLOEXEC);
    pthread_mutex_init(&bus->mutex, NULL);
    int good = bus->wake_fd >= 0 && bus->notice_fd >= 0 && make_ring(&bus->responses, IO_RESPONSES_MAX) &&
               make_ring(&bus->unclaimed, IO_FRAMES_MAX);
    if (kind != IO_BYTES)
        bound_kernel_queue(fd);
    if (!good || pthread_create(&bus->thread, NULL, run, bus)) {
        forget(bus);
        return NULL;
    }
    return bus;
}

void io_stop(struct io_bus *bus) {
    pthread_mutex_lock(&bus->mutex);
    bus->stopping = 1;
    wake(bus);
    pthread_mutex_unlock(&bus->mutex);
    pthread_join(bus->thread, NULL);
    forget(bus);
}

int io_notice_fd(struct io_bus *bus) {
    return bus->notice_fd;
}

// ------------------------------------------------------------------------------------------------------
// taking

static size_t take_ring(struct io_ring *ring, struct io_event *out, size_t room) {
    size_t taken = 0;
    for (; taken < room && ring->count; taken++, ring->count--) {
        out[taken] = ring->events[ring->first];
        ring->first = (ring->first + 1) % ring->size;
    }
    return taken;
}

// Moves one flag out as an event; returns whether it did.
static int take_flag(uint8_t *flag, struct io_event *out, struct io_event event) {
    if (!*flag)
        return 0;
    *flag = 0;
    *out = event;
    return 1;
}

static size_t take_notices(struct io_bus *bus, struct io_event *out, size_t room) {
    size_t taken = 0;
    for (size_t i = 0; i < bus->link_count && room - taken >= 2; i++) {
        struct io_link *node = bus->links[i];
        struct io_event drained = {.notice = IO_DRAINED, .link = node->number};
        struct io_event lost = {.notice = IO_LOST, .link = node->number, .value = (int32_t)node->link.cause};
        taken += (size_t)take_flag(&node->drained_pending, out + taken, drained);
        taken += (size_t)take_flag(&node->lost_pending, out + taken, lost);
    }
    struct io_event ended = {.notice = IO_ENDED, .value = bus->ended_errno};
    if (taken < room)
        taken += (size_t)take_flag(&bus->ended_pending, out + taken, ended);
    return taken;
}

size_t io_take(struct io_bus *bus, struct io_event *out, size_t room) {
    pthread_mutex_lock(&bus->mutex);
    size_t taken = take_ring(&bus->responses, out, room);
    taken += take_ring(&bus->unclaimed, out + taken, room - taken);
    taken += take_notices(bus, out + taken, room - taken);
    uint64_t count;
    if (taken < room && bus->noticed && read(bus->notice_fd, &count, sizeof count) == sizeof count)
        bus->noticed = 0;
    pthread_mutex_unlock(&bus->mutex);
    return taken;
}

// -------------------------------------------------------------------------------------------------------
// links

static enum io_status add_link(struct io_bus *bus, unsigned nodeid, const struct link_settings *settings,
                               uint32_t *number) {
    int taken = bus->kind == IO_BYTES ? bus->link_count > 0 : bus->by_nodeid[nodeid] != NULL;
    if (taken || bus->link_count == IO_LINKS_MAX)
        return IO_TAKEN;
    struct io_link *node = calloc(1, sizeof *node);
    if (!node)
        return IO_NO_MEMORY;
    link_init(&node->link, settings, node->control_memory, IO_CONTROL_BYTES, node->motion_memory,
              IO_MOTION_BYTES);
    node->nodeid = (uint8_t)nodeid;
    node->number = *number = ++bus->last_number;
    bus->links[bus->link_count++] = node;
    if (bus->kind != IO_BYTES)
        bus->by_nodeid[nodeid] = node;
    return IO_OK;
}

enum io_status io_open_link(struct io_bus *bus, unsigned nodeid, const struct link_settings *settings,
                            uint32_t *number) {
    if (nodeid > 255 || (bus->kind == IO_BYTES) != (nodeid == 0) || !settings->lost_after_ns ||
        settings->receive_window < LINK_WINDOW_MIN)
        return IO_INVALID;
    pthread_mutex_lock(&bus->mutex);
    enum io_status status = bus->ended ? IO_CLOSED : add_link(bus, nodeid, settings, number);
    pthread_mutex_unlock(&bus->mutex);
    return status;
}

static size_t index_of(const struct io_bus *bus, uint32_t number) {
    size_t at = 0;
    while (at < bus->link_count && bus->links[at]->number != number)
        at++;
    return at;
}

void io_close_link(struct io_bus *bus, uint32_t number) {
    pthread_mutex_lock(&bus->mutex);
    size_t at = index_of(bus, number);
    if (at < bus->link_count) {
        struct io_link *node = bus->links[at];
        bus->by_nodeid[node->nodeid] = NULL;
        bus->link_count--;
        memmove(bus->links + at, bus->links + at + 1, (bus->link_count - at) * sizeof *bus->links);
        free(node);
    }
    pthread_mutex_unlock(&bus->mutex);
}

// Locks the bus and finds the link; NULL (and *status): it cannot be used.
static struct io_link *enter(struct io_bus *bus, uint32_t number, enum io_status *status) {
    pthread_mutex_lock(&bus->mutex);
    size_t at = index_of(bus, number);
    *status = bus->ended ? IO_CLOSED : at == bus->link_count ? IO_GONE : IO_OK;
    return *status == IO_OK ? bus->links[at] : NULL;
}

static enum io_status leave(struct io_bus *bus, enum io_status status) {
    if (status == IO_OK)
        send_now(bus);
    pthread_mutex_unlock(&bus->mutex);
    return status;
}

static enum io_status from_link(enum link_status status) {
    static const enum io_status same[] = {
        [LINK_OK] = IO_OK, [LINK_FULL] = IO_FULL, [LINK_INVALID] = IO_INVALID, [LINK_GONE] = IO_GONE};
    return same[status];
}

enum io_status io_send(struct io_bus *bus, uint32_t number, const uint8_t *content, size_t size,
                       uint64_t min_clock, uint64_t req_clock) {
    enum io_status status;
    struct io_link *node = enter(bus, number, &status);
    if (node)
        status = from_link(link_send(&node->link, content, size, min_clock, req_clock));
    return leave(bus, status);
}

enum io_status io_send_batch(struct io_bus *bus, uint32_t number, const uint8_t *batch, size_t size) {
    enum io_status status;
    struct io_link *node = enter(bus, number, &status);
    if (node)
        status = from_link(link_send_batch(&node->link, batch, size));
    return leave(bus, status);
}

enum io_status io_send_urgent(struct io_bus *bus, uint32_t number, const uint8_t *content, size_t size) {
    enum io_status status;
    struct io_link *node = enter(bus, number, &status);
    if (node)
        status = from_link(link_send_urgent(&node->link, content, size));
    return leave(bus, status);
}

enum io_status io_set_receive_window(struct io_bus *bus, uint32_t number, uint64_t size) {
    enum io_status status;
    struct io_link *node = enter(bus, number, &status);
    if (node)
        status = from_link(link_set_receive_window(&node->link, size));
    return leave(bus, status);
}

enum io_status io_set_clock(struct io_bus *bus, uint32_t number, double freq_hz, uint64_t at_ns,
                            uint64_t at_ticks) {
    enum io_status status;
    struct io_link *node = enter(bus, number, &status);
    if (node)
        status = from_link(link_set_clock(&node->link, freq_hz, at_ns, at_ticks));
    return leave(bus, status);
}

enum io_status io_watch_drained(struct io_bus *bus, uint32_t number) {
    enum io_status status;
    struct io_link *node = enter(bus, number, &status);
    if (node) {
        node->watch_drained = 1;
        note_states(bus);
    }
    return leave(bus, status);
}

enum io_status io_send_frame(struct io_bus *bus, uint32_t can_id, const uint8_t *data, size_t size) {
    if (size > CAN_MAX_DLEN || bus->kind == IO_BYTES)
        return IO_INVALID;
    pthread_mutex_lock(&bus->mutex);
    if (bus->ended || bus->admin_count == IO_ADMIN_MAX)
        return leave(bus, bus->ended ? IO_CLOSED : IO_FULL);
    struct can_frame *frame = &bus->admin[(bus->admin_first + bus->admin_count++) % IO_ADMIN_MAX];
    *frame = (struct can_frame){.can_id = can_id, .can_dlc = (uint8_t)size};
    memcpy(frame->data, data, size);
    if (bus->admin_count > bus->stats.admin_max)
        bus->stats.admin_max = bus->admin_count;
    return leave(bus, IO_OK);
}

// ----------------------------------------------------------------------------------------------------
// counters

enum io_status io_get_link_stats(struct io_bus *bus, uint32_t number, struct io_link_stats *out) {
    enum io_status status;
    struct io_link *node = enter(bus, number, &status);
    if (!node) {
        size_t at = index_of(bus, number);
        node = at < bus->link_count ? bus->links[at] : NULL; // the counters of an ended bus stay readable
    }
    if (node) {
        const struct link *link = &node->link;
        const struct link_queue *control = &link->control, *motion = &link->motion;
        *out = (struct io_link_stats){
            .pending = link_pending(link),
            .control_commands = control->commands,
            .control_bytes = link_queue_bytes(control),
            .control_commands_max = control->commands_max,
            .control_bytes_max = control->bytes_max,
            .motion_commands = motion->commands,
            .motion_bytes = link_queue_bytes(motion),
            .motion_commands_max = motion->commands_max,
            .motion_bytes_max = motion->bytes_max,
            .flying_bytes = link->flying_bytes,
            .flying_blocks = link->next - link->first,
        };
        link_get_stats(link, &out->link);
    }
    pthread_mutex_unlock(&bus->mutex);
    return node ? IO_OK : status;
}

void io_get_stats(struct io_bus *bus, struct io_stats *out) {
    pthread_mutex_lock(&bus->mutex);
    *out = bus->stats;
    pthread_mutex_unlock(&bus->mutex);
}
