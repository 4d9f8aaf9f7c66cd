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

enum { KERNEL_FRAMES = 16 };

static uint64_t monotonic_ns(void) {
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    return (uint64_t)now.tv_sec * NS_PER_S + (uint64_t)now.tv_nsec;
}

// -------------------------------------------------------------------------------------------------- thread

void io_note_states(struct io_bus *bus) {
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
        io_note_states(bus);
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
void io_send_now(struct io_bus *bus) {
    if (!bus->sleeping)
        return; // the thread is at work, or on its way to it, and will find what was queued
    uint64_t now = monotonic_ns();
    io_write_all(bus, now);
    if (bus->ended || bus->kernel_full || next_deadline(bus, now) < bus->sleep_until_ns)
        wake(bus);
}

// ------------------------------------------------------------------------------------------- start and end

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

// What sits in the kernel cannot be overtaken by something more urgent. A small send buffer bounds it, and
// makes a full SocketCAN queue show as "not writable" instead of as ENOBUFS. The kernel accounts some 768
// bytes for a frame (or for a short run of them on a stream) and doubles the figure it is given. No socket:
// no such buffer.
static void bound_kernel_queue(int fd) {
    int bytes = KERNEL_FRAMES * 768 / 2;
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

// -------------------------------------------------------------------------------------------------- taking

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
