// SPDX-License-Identifier: Apache-2.0
// The thread that drives a bus over a file descriptor.
#define _GNU_SOURCE
#include "nodes/link/io/io_thread.h"

#include <errno.h>
#include <linux/can.h>
#include <linux/sock_diag.h>
#include <poll.h>
#include <pthread.h>
#include <stdlib.h>
#include <sys/eventfd.h>
#include <sys/ioctl.h>
#include <sys/socket.h>
#include <sys/timerfd.h>
#include <time.h>
#include <unistd.h>

#define NS_PER_S 1000000000ULL
// SocketCAN returns ENOBUFS while the interface's queue is full, but reports the socket as writable: wait. A
// full frame lasts 111 µs and more.
#define NO_BUFFERS_NS 300000ULL
#define OVERSLEPT_NS 2000000ULL
// A deadline that moves by less, as with each acknowledgement, leaves the timer as it is: it is early.
#define TIMER_EARLY_NS 5000000ULL

enum { KERNEL_FRAMES = 16, FRAME = sizeof(struct can_frame), SKB_BYTES = 768, WRITES = 32 };

struct io_thread {
    int fd, wake_fd, timer_fd, notice_fd;
    enum io_kind kind;
    struct io_bus *bus;
    pthread_t thread;
    pthread_mutex_t mutex;
    uint8_t stopping;
    uint8_t notice_due;      // make notice_fd readable once the lock is free
    uint8_t kernel_full;     // wait until the descriptor is writable
    uint8_t unread;          // something may have been received that nobody waited for
    uint64_t retry_ns;       // when to try again after ENOBUFS; 0: not now
    uint64_t sleep_until_ns; // what the timer is set to; UINT64_MAX: it is not
    uint8_t out[IO_OUT_FRAMES * FRAME];
    size_t out_at, out_size;
    uint8_t in[64 * FRAME];
    uint8_t write_frames[WRITES]; // of the last writes, to convert the kernel's buffers to frames
    unsigned writes;
};

static uint64_t monotonic_ns(void) {
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    return (uint64_t)now.tv_sec * NS_PER_S + (uint64_t)now.tv_nsec;
}

// ------------------------------------------------------------------------------------------------ transfer

// Reads what has arrived; returns the time after the last read that gave something, NOW before the first.
// Each piece gets the time after its own read: it may have arrived after NOW, and a node's clock is believed
// to have been read before its answer was received.
static uint64_t read_all(struct io_thread *thread, uint64_t now) {
    // Bounded, so that a flood cannot prevent sending; the remainder wakes the thread again at once. Enough
    // for everything that waits after a stall of the host, so that no acknowledgement counts as late.
    for (int rounds = 0; rounds < 1024 && !io_ended(thread->bus); rounds++) {
        size_t room = thread->kind == IO_CAN_PACKET ? FRAME : sizeof thread->in;
        ssize_t size = read(thread->fd, thread->in, room);
        if (size > 0) {
            now = monotonic_ns();
            io_received(thread->bus, thread->in, (size_t)size, now);
            if (thread->kind != IO_CAN_PACKET && (size_t)size < room)
                break; // a stream returned less than requested: it is empty
        } else if (size == 0) {
            io_end(thread->bus, 0);
        } else if (errno == EAGAIN) {
            break;
        } else if (errno != EINTR) {
            io_end(thread->bus, errno);
        }
    }
    return now;
}

// Writes bytes to the kernel; returns 0 when it accepts no more.
static int flush(struct io_thread *thread, uint64_t now) {
    while (thread->out_at < thread->out_size) {
        size_t size = thread->kind == IO_CAN_PACKET ? FRAME : thread->out_size - thread->out_at;
        ssize_t done = write(thread->fd, thread->out + thread->out_at, size);
        if (done > 0) {
            thread->out_at += (size_t)done;
            thread->write_frames[thread->writes++ % WRITES] = (uint8_t)((size_t)done / FRAME);
            continue;
        }
        if (done < 0 && errno == EINTR)
            continue;
        if (done < 0 && errno == ENOBUFS)
            thread->retry_ns = now + NO_BUFFERS_NS;
        else if (done == 0 || errno == EAGAIN)
            thread->kernel_full = 1;
        else
            io_end(thread->bus, errno);
        io_count_wait(thread->bus);
        return 0;
    }
    return 1;
}

// Returns how many frames (a serial line: bytes) the kernel reports as queued. It counts buffers,
// SKB_BYTES for a write of up to some ten frames (measured on x86-64: AF_UNIX, and vcan, where a frame has
// one of its own). Frames that wait in an adapter or in the virtual bus are not reported: the core estimates
// them from the bit rate, and the greater of both counts.
static uint64_t queued(const struct io_thread *thread) {
    if (!io_bounds_queue(thread->bus))
        return IO_QUEUED_UNKNOWN;
    int bytes;
    if (thread->kind == IO_BYTES)
        return ioctl(thread->fd, TIOCOUTQ, &bytes) == 0 ? (uint64_t)bytes : IO_QUEUED_UNKNOWN;
    uint32_t memory[SK_MEMINFO_VARS];
    socklen_t size = sizeof memory;
    if (getsockopt(thread->fd, SOL_SOCKET, SO_MEMINFO, memory, &size) != 0 ||
        size <= SK_MEMINFO_WMEM_ALLOC * sizeof memory[0]) // an emulated kernel may give less
        return IO_QUEUED_UNKNOWN;
    uint64_t frames = 0;
    unsigned buffers = memory[SK_MEMINFO_WMEM_ALLOC] / SKB_BYTES;
    for (unsigned i = 1; i <= buffers && i <= WRITES; i++) // unused entries have no frames
        frames += thread->write_frames[(thread->writes - i) % WRITES];
    return frames;
}

static void write_all(struct io_thread *thread, uint64_t now) {
    if (io_ended(thread->bus) || thread->kernel_full || now < thread->retry_ns)
        return;
    thread->retry_ns = 0;
    while (flush(thread, now)) {
        thread->out_at = 0;
        thread->out_size = io_next(thread->bus, now, queued(thread), thread->out, sizeof thread->out);
        if (thread->out_size == 0)
            return;
    }
}

// -------------------------------------------------------------------------------------------------- thread

static uint64_t next_deadline(const struct io_thread *thread, uint64_t now) {
    uint64_t at_ns = io_deadline(thread->bus, now);
    return thread->retry_ns && !io_ended(thread->bus) && thread->retry_ns < at_ns ? thread->retry_ns : at_ns;
}

// Makes an eventfd readable; it holds 2^64-2 such ones.
static void signal_event(int fd) {
    uint64_t one = 1;
    ssize_t done = write(fd, &one, sizeof one);
    (void)done;
}

// Makes an eventfd unreadable; there is no other reader.
static void drain(int fd) {
    uint64_t count;
    ssize_t done = read(fd, &count, sizeof count);
    (void)done;
}

// Gives the lock back, and notifies the program if that is due: one that is woken before waits for the lock.
static void release(struct io_thread *thread) {
    int notice_due = thread->notice_due;
    thread->notice_due = 0;
    pthread_mutex_unlock(&thread->mutex);
    if (notice_due)
        signal_event(thread->notice_fd);
}

// Wakes the thread at AT_NS; UINT64_MAX: never. A timer that has expired is readable until it is set again.
static void set_timer(struct io_thread *thread, uint64_t at_ns) {
    thread->sleep_until_ns = at_ns;
    struct itimerspec timer = {0}; // disarmed
    if (at_ns != UINT64_MAX)
        timer.it_value =
            (struct timespec){.tv_sec = (time_t)(at_ns / NS_PER_S), .tv_nsec = (long)(at_ns % NS_PER_S)};
    timerfd_settime(thread->timer_fd, TFD_TIMER_ABSTIME, &timer, NULL);
}

// Whether the timer is set to a time so near before AT_NS that it may stay.
static int timer_suits(const struct io_thread *thread, uint64_t now, uint64_t at_ns) {
    uint64_t set_ns = thread->sleep_until_ns;
    return now < set_ns && set_ns <= at_ns && at_ns - set_ns < TIMER_EARLY_NS;
}

// Sleeps until the descriptor, a caller or the timer wakes it; returns the descriptor's events.
static short sleep_unlocked(struct io_thread *thread, uint64_t now) {
    thread->unread = io_may_stay_unread(thread->bus, now) && !thread->kernel_full;
    struct pollfd fds[3] = {
        {.fd = io_ended(thread->bus) || thread->unread ? -1 : thread->fd, .events = POLLIN},
        {.fd = thread->wake_fd, .events = POLLIN},
        {.fd = thread->timer_fd, .events = POLLIN}};
    if (thread->kernel_full)
        fds[0].events |= POLLOUT;
    uint64_t at_ns = next_deadline(thread, now);
    if (!timer_suits(thread, now, at_ns))
        set_timer(thread, at_ns);
    release(thread);
    poll(fds, 3, -1); // on failure: no events
    if (fds[1].revents & POLLIN)
        drain(thread->wake_fd);
    pthread_mutex_lock(&thread->mutex);
    io_count_wakeup(thread->bus);
    return fds[0].revents;
}

// In the first 2 ms of a computer's uptime the answer is yes, which costs a needless read.
static int overslept(const struct io_thread *thread, uint64_t now) {
    return now - OVERSLEPT_NS > thread->sleep_until_ns;
}

static void *run(void *argument) {
    struct io_thread *thread = argument;
    pthread_mutex_lock(&thread->mutex);
    short seen = POLLIN;
    while (!thread->stopping) {
        uint64_t now = monotonic_ns();
        if (seen & POLLOUT)
            thread->kernel_full = 0;
        // After sleeping too long, on a busy computer, read what has arrived before timers are evaluated.
        if ((seen & ~POLLOUT) || thread->unread || overslept(thread, now))
            now = read_all(thread, now);
        io_handle_time(thread->bus, now);
        write_all(thread, now);
        seen = sleep_unlocked(thread, now);
    }
    release(thread);
    return NULL;
}

// -------------------------------------------------------------------------------------- what the core calls

static uint64_t now_of(void *context) {
    (void)context;
    return monotonic_ns();
}

static void lock(void *context) {
    pthread_mutex_lock(&((struct io_thread *)context)->mutex);
}

static void unlock(void *context) {
    release(context);
}

// The caller sends what it queued itself and sets the thread's timer to a new deadline; the thread sleeps on,
// and is woken only when it has to poll for something else: what it did not wait for may be an answer now.
static void kick(void *context) {
    struct io_thread *thread = context;
    int was_full = thread->kernel_full, had_ended = io_ended(thread->bus);
    uint64_t now = monotonic_ns();
    write_all(thread, now);
    uint64_t at_ns = next_deadline(thread, now);
    if (at_ns < thread->sleep_until_ns)
        set_timer(thread, at_ns);
    int late = thread->unread && !io_may_stay_unread(thread->bus, now);
    if (thread->kernel_full != was_full || io_ended(thread->bus) != had_ended || late)
        signal_event(thread->wake_fd);
}

static void notify(void *context) {
    ((struct io_thread *)context)->notice_due = 1;
}

static void quiet(void *context) {
    drain(((struct io_thread *)context)->notice_fd);
}

// ------------------------------------------------------------------------------------------- start and end

static void forget(struct io_thread *thread) {
    if (thread->bus)
        io_free(thread->bus);
    const int fds[] = {thread->wake_fd, thread->timer_fd, thread->notice_fd};
    for (size_t i = 0; i < sizeof fds / sizeof *fds; i++)
        if (fds[i] >= 0)
            close(fds[i]);
    pthread_mutex_destroy(&thread->mutex);
    free(thread);
}

// What waits in the kernel cannot be overtaken by something more urgent. A small send buffer bounds it, and
// makes a full SocketCAN queue show as "not writable" instead of as ENOBUFS. The kernel accounts some 768
// bytes for a frame (or for a short run of them on a stream) and doubles the figure it is given. No socket:
// no such buffer.
static void bound_kernel_queue(int fd) {
    int bytes = KERNEL_FRAMES * SKB_BYTES / 2;
    setsockopt(fd, SOL_SOCKET, SO_SNDBUF, &bytes, sizeof bytes);
}

struct io_thread *io_start(int fd, enum io_kind kind, const struct io_settings *settings) {
    static const struct io_driver driver = {now_of, lock, unlock, kick, notify, quiet};
    struct io_thread *thread = calloc(1, sizeof *thread);
    if (!thread)
        return NULL;
    thread->fd = fd;
    thread->kind = kind;
    thread->wake_fd = eventfd(0, EFD_NONBLOCK | EFD_CLOEXEC);
    thread->notice_fd = eventfd(0, EFD_NONBLOCK | EFD_CLOEXEC);
    thread->timer_fd = timerfd_create(CLOCK_MONOTONIC, TFD_NONBLOCK | TFD_CLOEXEC);
    thread->bus = io_new(kind, settings, &driver, thread);
    pthread_mutex_init(&thread->mutex, NULL);
    if (kind != IO_BYTES)
        bound_kernel_queue(fd);
    if (thread->wake_fd < 0 || thread->timer_fd < 0 || thread->notice_fd < 0 || !thread->bus ||
        pthread_create(&thread->thread, NULL, run, thread)) {
        forget(thread);
        return NULL;
    }
    return thread;
}

void io_stop(struct io_thread *thread) {
    pthread_mutex_lock(&thread->mutex);
    thread->stopping = 1;
    signal_event(thread->wake_fd);
    pthread_mutex_unlock(&thread->mutex);
    pthread_join(thread->thread, NULL);
    forget(thread);
}

struct io_bus *io_thread_bus(struct io_thread *thread) {
    return thread->bus;
}

int io_notice_fd(struct io_thread *thread) {
    return thread->notice_fd;
}
