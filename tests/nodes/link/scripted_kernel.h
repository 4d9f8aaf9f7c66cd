// SPDX-License-Identifier: Apache-2.0
// The kernel under a bus's I/O thread, by script: clock, descriptors, mutex and sleep. Thread and test take
// turns, exactly one of them runs at any moment, and time passes only when the test says so: each call can be
// counted and each timeout compared to the nanosecond. Include it before nodes/link/io/io_thread.c, whose
// calls it takes; io_thread.c is no source of the program then.
#ifndef SCRIPTED_KERNEL_H
#define SCRIPTED_KERNEL_H

#include <errno.h>
#include <linux/can.h>
#include <linux/sock_diag.h>
#include <poll.h>
#include <pthread.h>
#include <semaphore.h>
#include <stdarg.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>
#include <sys/eventfd.h>
#include <sys/ioctl.h>
#include <sys/socket.h>
#include <sys/timerfd.h>
#include <time.h>
#include <unistd.h>

#include "tests/check.h"

enum { LINE_FD = 50, EVENT_FDS = 8, STEPS_MAX = 64, WRITES_MAX = 256, KERNEL_BUFFER = 768 };

// What a call on the line gives: bytes taken or given, or an errno.
struct step {
    ssize_t size;
    int error;
    const uint8_t *data; // of a read
    uint64_t takes_ns;   // time that passes meanwhile, of a read
};

static struct kernel {
    uint64_t now_ns;
    // The line. A script that is used up: a read finds nothing, a write takes everything.
    struct step reads[STEPS_MAX], writes[STEPS_MAX];
    size_t reads_left, reads_at, writes_left, writes_at;
    const struct can_frame *flood; // what each read gives instead, for ever
    unsigned read_calls, write_calls, queue_calls;
    size_t read_room; // of the last read
    size_t write_sizes[WRITES_MAX];
    uint8_t sent[8192];
    size_t sent_size;
    uint32_t waiting; // that the kernel says it has: a socket's memory, a serial line's bytes
    uint32_t growth;  // of it by each write
    int queue_error;  // instead of saying so
    int send_buffer;
    // Eventfds.
    int next_event_fd[2]; // what eventfd() returns; -1: it fails
    int next_timer_fd;    // what timerfd_create() returns; -1: it fails
    unsigned event_calls;
    uint64_t count[EVENT_FDS];
    uint8_t is_open[EVENT_FDS];
    // The thread, its mutex, its memory and its sleep.
    uint8_t no_memory;
    int thread_error; // that pthread_create() gives
    unsigned threads;
    pthread_t owner;
    uint8_t held, mutex_exists, is_joining;
    sem_t to_thread, to_test;
    struct pollfd *polled;
    short line_events; // what the thread sleeps for
    int line_fd;
    uint64_t timer_ns; // when the timer expires; UINT64_MAX: it is disarmed
    unsigned timer_calls;
} kernel;

static inline void kernel_reset(void) {
    kernel = (struct kernel){.now_ns = 5123456789,
                             .next_event_fd = {3, 4},
                             .next_timer_fd = 5,
                             .send_buffer = -1,
                             .timer_ns = UINT64_MAX};
    CHECK(sem_init(&kernel.to_thread, 0, 0) == 0 && sem_init(&kernel.to_test, 0, 0) == 0);
}

// --------------------------------------------------------------------------------------- time, mutex, thread

static inline int kernel_clock_gettime(clockid_t clock, struct timespec *out) {
    CHECK_EQUAL(clock, CLOCK_MONOTONIC);
    out->tv_sec = (time_t)(kernel.now_ns / 1000000000);
    out->tv_nsec = (long)(kernel.now_ns % 1000000000);
    return 0;
}

static inline int kernel_is_mine(void) {
    return kernel.held && pthread_equal(kernel.owner, pthread_self());
}

static inline int kernel_mutex_init(pthread_mutex_t *mutex, const pthread_mutexattr_t *attributes) {
    (void)mutex;
    CHECK(!attributes && !kernel.mutex_exists);
    kernel.mutex_exists = 1;
    return 0;
}

static inline int kernel_mutex_lock(pthread_mutex_t *mutex) {
    (void)mutex;
    CHECK(kernel.mutex_exists && !kernel.held);
    kernel.held = 1;
    kernel.owner = pthread_self();
    return 0;
}

static inline int kernel_mutex_unlock(pthread_mutex_t *mutex) {
    (void)mutex;
    CHECK(kernel_is_mine());
    kernel.held = 0;
    return 0;
}

static inline int kernel_mutex_destroy(pthread_mutex_t *mutex) {
    (void)mutex;
    CHECK(kernel.mutex_exists && !kernel.held);
    kernel.mutex_exists = 0;
    return 0;
}

static inline void *kernel_calloc(size_t count, size_t size) {
    return kernel.no_memory ? NULL : calloc(count, size);
}

// The thread runs until it sleeps.
static inline int kernel_thread_create(pthread_t *thread, const pthread_attr_t *attributes,
                                       void *(*body)(void *), void *argument) {
    if (kernel.thread_error)
        return kernel.thread_error;
    kernel.threads++;
    CHECK_EQUAL(pthread_create(thread, attributes, body, argument), 0);
    sem_wait(&kernel.to_test);
    return 0;
}

static inline uint64_t *count_of(int fd) {
    CHECK(fd >= 0 && fd < EVENT_FDS && kernel.is_open[fd]);
    return &kernel.count[fd];
}

static inline int kernel_thread_join(pthread_t thread, void **result) {
    CHECK(*count_of(kernel.polled[1].fd) > 0); // somebody woke it
    kernel.is_joining = 1;
    kernel.polled[1].revents = POLLIN;
    sem_post(&kernel.to_thread);
    CHECK_EQUAL(pthread_join(thread, result), 0);
    CHECK(!kernel.held);
    kernel.threads--;
    return 0;
}

static inline int kernel_poll(struct pollfd *fds, nfds_t size, int timeout_ms) {
    CHECK(size == 3 && timeout_ms == -1 && !kernel.held && !kernel.is_joining);
    CHECK(fds[1].events == POLLIN && fds[2].events == POLLIN);
    CHECK(count_of(fds[1].fd) && count_of(fds[2].fd));
    kernel.polled = fds;
    kernel.line_fd = fds[0].fd;
    kernel.line_events = fds[0].events;
    sem_post(&kernel.to_test);
    sem_wait(&kernel.to_thread);
    return (fds[0].revents != 0) + (fds[1].revents != 0) + (fds[2].revents != 0);
}

// After how long the sleeping thread wakes by itself; -1: never.
static inline int64_t kernel_timeout_ns(void) {
    return kernel.timer_ns == UINT64_MAX ? -1 : (int64_t)(kernel.timer_ns - kernel.now_ns);
}

// Ends the thread's sleep, with SEEN on the line, and returns when it sleeps again. Its wake-up is seen, too,
// if it was woken, and its timer, if that has expired; nothing of all: poll() failed.
static inline void kernel_turn(short seen) {
    CHECK(!seen || kernel.line_fd == LINE_FD);
    CHECK(!(seen & ~(kernel.line_events | POLLERR | POLLHUP)));
    kernel.polled[0].revents = seen;
    kernel.polled[1].revents = *count_of(kernel.polled[1].fd) ? POLLIN : 0;
    kernel.polled[2].revents = kernel.timer_ns <= kernel.now_ns ? POLLIN : 0;
    kernel.read_calls = kernel.write_calls = kernel.queue_calls = 0;
    sem_post(&kernel.to_thread);
    sem_wait(&kernel.to_test);
}

// Lets time pass until the thread's sleep ends, and LATE_NS more.
static inline void kernel_sleep_out(uint64_t late_ns) {
    CHECK(kernel_timeout_ns() >= 0);
    kernel.now_ns = kernel.timer_ns + late_ns;
    kernel_turn(0);
}

// Whether somebody has woken the thread.
static inline int kernel_is_woken(void) {
    return *count_of(kernel.polled[1].fd) > 0;
}

// ----------------------------------------------------------------------------------------------- descriptors

static inline int kernel_eventfd(unsigned count, int flags) {
    CHECK_EQUAL(count, 0);
    CHECK_EQUAL(flags, EFD_NONBLOCK | EFD_CLOEXEC);
    CHECK(kernel.event_calls < 2);
    int fd = kernel.next_event_fd[kernel.event_calls++];
    if (fd >= 0) {
        CHECK(!kernel.is_open[fd]);
        kernel.is_open[fd] = 1;
    }
    return fd;
}

static inline int kernel_timerfd_create(clockid_t clock, int flags) {
    CHECK_EQUAL(clock, CLOCK_MONOTONIC);
    CHECK_EQUAL(flags, TFD_NONBLOCK | TFD_CLOEXEC);
    if (kernel.next_timer_fd >= 0) {
        CHECK(!kernel.is_open[kernel.next_timer_fd]);
        kernel.is_open[kernel.next_timer_fd] = 1;
    }
    return kernel.next_timer_fd;
}

static inline int kernel_timerfd_settime(int fd, int flags, const struct itimerspec *timer,
                                         struct itimerspec *old) {
    CHECK(fd == kernel.next_timer_fd && count_of(fd) && !old && kernel_is_mine());
    CHECK_EQUAL(flags, TFD_TIMER_ABSTIME);
    CHECK(timer->it_interval.tv_sec == 0 && timer->it_interval.tv_nsec == 0);
    CHECK(timer->it_value.tv_sec >= 0 && timer->it_value.tv_nsec >= 0 &&
          timer->it_value.tv_nsec < 1000000000);
    uint64_t at_ns = (uint64_t)timer->it_value.tv_sec * 1000000000 + (uint64_t)timer->it_value.tv_nsec;
    kernel.timer_ns = at_ns ? at_ns : UINT64_MAX;
    kernel.timer_calls++;
    return 0;
}

static inline int kernel_close(int fd) {
    count_of(fd);
    kernel.is_open[fd] = 0;
    return 0;
}

static inline unsigned kernel_open_fds(void) {
    unsigned open = 0;
    for (int fd = 0; fd < EVENT_FDS; fd++)
        open += kernel.is_open[fd];
    return open;
}

static inline ssize_t kernel_result(const struct step *step) {
    errno = step->error;
    return step->size;
}

static inline ssize_t kernel_read(int fd, void *out, size_t room) {
    if (fd != LINE_FD) {
        uint64_t *count = count_of(fd);
        CHECK_EQUAL(room, sizeof *count);
        if (!*count) {
            errno = EAGAIN;
            return -1;
        }
        memcpy(out, count, sizeof *count);
        *count = 0;
        return sizeof *count;
    }
    CHECK(kernel_is_mine());
    CHECK(++kernel.read_calls < 2000);
    kernel.read_room = room;
    if (kernel.flood) {
        memcpy(out, kernel.flood, sizeof *kernel.flood);
        return sizeof *kernel.flood;
    }
    if (!kernel.reads_left) {
        errno = EAGAIN;
        return -1;
    }
    kernel.reads_left--;
    const struct step *step = &kernel.reads[kernel.reads_at++];
    CHECK(step->size <= (ssize_t)room);
    kernel.now_ns += step->takes_ns;
    if (step->size > 0)
        memcpy(out, step->data, (size_t)step->size);
    return kernel_result(step);
}

static inline ssize_t kernel_write(int fd, const void *data, size_t size) {
    if (fd != LINE_FD) {
        uint64_t added;
        CHECK_EQUAL(size, sizeof added);
        memcpy(&added, data, sizeof added);
        CHECK_EQUAL(added, 1);
        CHECK(fd != kernel.next_event_fd[1] || !kernel_is_mine()); // who is woken by it takes the lock
        *count_of(fd) += added;
        return sizeof added;
    }
    CHECK(kernel_is_mine() && size > 0 && kernel.write_calls < WRITES_MAX);
    kernel.write_sizes[kernel.write_calls++] = size;
    struct step step = {.size = (ssize_t)size};
    if (kernel.writes_left) {
        kernel.writes_left--;
        step = kernel.writes[kernel.writes_at++];
    }
    CHECK(step.size <= (ssize_t)size);
    if (step.size > 0) {
        CHECK(kernel.sent_size + (size_t)step.size <= sizeof kernel.sent);
        memcpy(kernel.sent + kernel.sent_size, data, (size_t)step.size);
        kernel.sent_size += (size_t)step.size;
        kernel.waiting += kernel.growth;
    }
    return kernel_result(&step);
}

// What they say counts only when they succeed.
static inline int kernel_getsockopt(int fd, int level, int option, void *out, socklen_t *size) {
    CHECK(fd == LINE_FD && level == SOL_SOCKET && option == SO_MEMINFO && kernel_is_mine());
    CHECK_EQUAL(*size, SK_MEMINFO_VARS * sizeof(uint32_t));
    CHECK(++kernel.queue_calls < 2000);
    memset(out, 0, *size);
    ((uint32_t *)out)[SK_MEMINFO_WMEM_ALLOC] = kernel.waiting;
    errno = kernel.queue_error;
    return kernel.queue_error ? -1 : 0;
}

static inline int kernel_ioctl(int fd, unsigned long request, int *out) {
    CHECK(fd == LINE_FD && request == TIOCOUTQ && kernel_is_mine());
    CHECK(++kernel.queue_calls < 2000);
    *out = (int)kernel.waiting;
    errno = kernel.queue_error;
    return kernel.queue_error ? -1 : 0;
}

static inline int kernel_setsockopt(int fd, int level, int option, const void *value, socklen_t size) {
    CHECK(fd == LINE_FD && level == SOL_SOCKET && option == SO_SNDBUF && size == sizeof(int));
    memcpy(&kernel.send_buffer, value, sizeof kernel.send_buffer);
    return 0;
}

#define calloc kernel_calloc
#define clock_gettime kernel_clock_gettime
#define close kernel_close
#define eventfd kernel_eventfd
#define getsockopt kernel_getsockopt
#define ioctl kernel_ioctl
#define poll kernel_poll
#define pthread_create kernel_thread_create
#define pthread_join kernel_thread_join
#define pthread_mutex_destroy kernel_mutex_destroy
#define pthread_mutex_init kernel_mutex_init
#define pthread_mutex_lock kernel_mutex_lock
#define pthread_mutex_unlock kernel_mutex_unlock
#define read kernel_read
#define setsockopt kernel_setsockopt
#define timerfd_create kernel_timerfd_create
#define timerfd_settime kernel_timerfd_settime
#define write kernel_write

#endif
