// SPDX-License-Identifier: Apache-2.0
// A world that runs FAST_CLOCK (environment; default 10) times as fast: preloaded into processes, it makes
// CLOCK_MONOTONIC run faster, and shortens what they wait for by as much. Between such processes all is as in
// real time on a computer that many times slower.
#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <poll.h>
#include <semaphore.h>
#include <stdint.h>
#include <stdlib.h>
#include <sys/epoll.h>
#include <sys/syscall.h>
#include <time.h>
#include <unistd.h>

enum { NS_PER_S = 1000000000, NS_PER_MS = 1000000 };

static int64_t factor(void) {
    static int64_t known;
    if (!known) {
        const char *text = getenv("FAST_CLOCK");
        known = text && atoi(text) > 0 ? atoi(text) : 10;
    }
    return known;
}

static struct timespec from_ns(int64_t ns) {
    return (struct timespec){.tv_sec = ns / NS_PER_S, .tv_nsec = ns % NS_PER_S};
}

static struct timespec shorter(const struct timespec *fast) {
    return from_ns(((int64_t)fast->tv_sec * NS_PER_S + fast->tv_nsec) / factor());
}

int clock_gettime(clockid_t id, struct timespec *out) {
    const int failed = (int)syscall(SYS_clock_gettime, id, out);
    if (!failed && id == CLOCK_MONOTONIC)
        *out = from_ns(((int64_t)out->tv_sec * NS_PER_S + out->tv_nsec) * factor());
    return failed;
}

int ppoll(struct pollfd *fds, nfds_t count, const struct timespec *timeout, const sigset_t *mask) {
    struct timespec wait = timeout ? shorter(timeout) : (struct timespec){0};
    return (int)syscall(SYS_ppoll, fds, count, timeout ? &wait : NULL, mask, sizeof(unsigned long));
}

int poll(struct pollfd *fds, nfds_t count, int timeout_ms) {
    const struct timespec timeout = from_ns((int64_t)timeout_ms * NS_PER_MS);
    return ppoll(fds, count, timeout_ms < 0 ? NULL : &timeout, NULL);
}

// A descriptor of epoll is readable itself when an event waits.
int epoll_wait(int fd, struct epoll_event *events, int most, int timeout_ms) {
    struct pollfd set = {.fd = fd, .events = POLLIN};
    if (timeout_ms && poll(&set, 1, timeout_ms) < 0)
        return -1;
    return (int)syscall(SYS_epoll_pwait, fd, events, most, 0, NULL, sizeof(unsigned long));
}

int clock_nanosleep(clockid_t id, int flags, const struct timespec *wanted, struct timespec *rest) {
    const struct timespec wait = id == CLOCK_MONOTONIC ? shorter(wanted) : *wanted;
    return syscall(SYS_clock_nanosleep, id, flags, &wait, rest) ? errno : 0;
}

int nanosleep(const struct timespec *wanted, struct timespec *rest) {
    const struct timespec wait = shorter(wanted);
    return (int)syscall(SYS_nanosleep, &wait, rest);
}

int sem_clockwait(sem_t *sem, clockid_t id, const struct timespec *until) {
    int (*const next)(sem_t *, clockid_t, const struct timespec *) =
        (int (*)(sem_t *, clockid_t, const struct timespec *))dlsym(RTLD_NEXT, "sem_clockwait");
    const struct timespec at = id == CLOCK_MONOTONIC ? shorter(until) : *until;
    return next(sem, id, &at);
}
