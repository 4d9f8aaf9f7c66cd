// SPDX-License-Identifier: Apache-2.0
// See hub_loop.h.
#define _GNU_SOURCE // accept4, ppoll
#include "nodes/virtual/hub_loop.h"

#include <errno.h>
#include <poll.h>
#include <pthread.h>
#include <stdlib.h>
#include <string.h>
#include <sys/eventfd.h>
#include <sys/prctl.h>
#include <sys/socket.h>
#include <time.h>
#include <unistd.h>

// Indices of the poll set: the event that wakes the thread, the listening socket, then the clients.
enum { AT_WAKE, AT_LISTEN, AT_CLIENTS, POLL_SIZE = AT_CLIENTS + HUB_CLIENTS };

enum { REALTIME_PRIORITY = 10 };

static const uint64_t NS_PER_S = 1000000000;
// Without free file descriptors, connections wait; immediate retries would only use CPU.
static const uint64_t ACCEPT_PAUSE_NS = 100000000;

struct hub_loop {
    pthread_mutex_t mutex; // guards everything below except wake_fd; unlocked while the thread sleeps
    int wake_fd, listen_fd;
    bool realtime, stopping;
    uint64_t late_ns_max;
    uint64_t accept_ns; // earliest time of the next accept()
    int fds[HUB_CLIENTS];
    bool input_closed[HUB_CLIENTS]; // the client has ended its output and may still read
    bool output_blocked[HUB_CLIENTS];
    struct hub hub;
};

static uint64_t monotonic_ns(void) {
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    return (uint64_t)now.tv_sec * NS_PER_S + (uint64_t)now.tv_nsec;
}

struct hub_loop *hub_loop_new(int listen_fd, const struct hub_config *config) {
    struct hub_loop *loop = calloc(1, sizeof(*loop));
    if (!loop)
        return NULL;
    loop->listen_fd = listen_fd;
    loop->wake_fd = eventfd(0, EFD_CLOEXEC | EFD_NONBLOCK);
    if (loop->wake_fd < 0) {
        free(loop);
        return NULL;
    }
    for (int i = 0; i < HUB_CLIENTS; i++)
        loop->fds[i] = -1;
    pthread_mutex_init(&loop->mutex, NULL);
    hub_init(&loop->hub, config);
    return loop;
}

void hub_loop_free(struct hub_loop *loop) {
    for (int i = 0; i < HUB_CLIENTS; i++)
        if (loop->fds[i] >= 0)
            close(loop->fds[i]);
    close(loop->wake_fd);
    pthread_mutex_destroy(&loop->mutex);
    free(loop);
}

void hub_loop_stop(struct hub_loop *loop) {
    pthread_mutex_lock(&loop->mutex);
    loop->stopping = true;
    pthread_mutex_unlock(&loop->mutex);
    eventfd_write(loop->wake_fd, 1);
}

void hub_loop_set_rules(struct hub_loop *loop, const struct hub_rule *rules, size_t count) {
    pthread_mutex_lock(&loop->mutex);
    hub_set_rules(&loop->hub, rules, count, monotonic_ns());
    pthread_mutex_unlock(&loop->mutex);
    eventfd_write(loop->wake_fd, 1); // a rule may be due before the thread would wake
}

// ------------------------------------------------------------------------------------------------- sockets

static void read_client(struct hub_loop *loop, int i, uint64_t now_ns) {
    uint8_t buffer[HUB_INPUT * HUB_RECORD];
    ssize_t got = recv(loop->fds[i], buffer, hub_room(&loop->hub, i), 0);
    if (got > 0)
        hub_receive(&loop->hub, i, buffer, (size_t)got, now_ns);
    else if (got == 0)
        loop->input_closed[i] = true;
    else if (errno != EAGAIN && errno != EINTR) {
        loop->input_closed[i] = true;
        hub_leave(&loop->hub, i, now_ns);
    }
}

static void write_client(struct hub_loop *loop, int i, uint64_t now_ns) {
    const uint8_t *data;
    size_t size;
    while ((size = hub_output(&loop->hub, i, &data)) > 0) {
        ssize_t put = send(loop->fds[i], data, size, MSG_NOSIGNAL);
        if (put < 0) {
            loop->output_blocked[i] = errno == EAGAIN || errno == EINTR;
            if (!loop->output_blocked[i])
                hub_leave(&loop->hub, i, now_ns);
            return;
        }
        hub_taken(&loop->hub, i, (size_t)put, now_ns);
    }
}

static void accept_clients(struct hub_loop *loop, uint64_t now_ns) {
    for (;;) {
        int fd = accept4(loop->listen_fd, NULL, NULL, SOCK_NONBLOCK | SOCK_CLOEXEC);
        if (fd < 0) {
            if (errno == EMFILE || errno == ENFILE || errno == ENOBUFS || errno == ENOMEM)
                loop->accept_ns = now_ns + ACCEPT_PAUSE_NS;
            return;
        }
        int place = hub_connect(&loop->hub);
        if (place < 0) {
            close(fd);
            continue;
        }
        loop->fds[place] = fd;
        loop->input_closed[place] = loop->output_blocked[place] = false;
    }
}

static void release_finished(struct hub_loop *loop) {
    for (int i = 0; i < HUB_CLIENTS; i++)
        if (loop->fds[i] >= 0 && hub_finished(&loop->hub, i) &&
            (loop->input_closed[i] || loop->hub.clients[i].state == HUB_EXPELLED)) {
            close(loop->fds[i]);
            loop->fds[i] = -1;
            hub_release(&loop->hub, i);
        }
}

// ------------------------------------------------------------------------------------------------- the loop

// Reads again when half a queue is free: many frames per system call, and the queue never runs empty while
// the client has more.
static short client_events(const struct hub_loop *loop, int i) {
    bool room = hub_room(&loop->hub, i) >= (size_t)HUB_INPUT / 2 * HUB_RECORD;
    bool blocked = loop->output_blocked[i] && loop->hub.clients[i].state == HUB_PRESENT;
    return (short)((room && !loop->input_closed[i] ? POLLIN : 0) | (blocked ? POLLOUT : 0));
}

static uint64_t fill_poll_set(const struct hub_loop *loop, struct pollfd *set, uint64_t now_ns) {
    uint64_t wake_ns = hub_deadline(&loop->hub);
    bool accepting = now_ns >= loop->accept_ns;
    if (!accepting && loop->accept_ns < wake_ns)
        wake_ns = loop->accept_ns;
    set[AT_WAKE] = (struct pollfd){.fd = loop->wake_fd, .events = POLLIN};
    set[AT_LISTEN] = (struct pollfd){.fd = accepting ? loop->listen_fd : -1, .events = POLLIN};
    for (int i = 0; i < HUB_CLIENTS; i++) {
        short events = (short)(loop->fds[i] >= 0 ? client_events(loop, i) : 0);
        // A client whose peer is gone would wake the thread all the time while its frames still wait.
        bool idle = events == 0 && loop->hub.clients[i].state != HUB_PRESENT;
        set[AT_CLIENTS + i] = (struct pollfd){.fd = idle ? -1 : loop->fds[i], .events = events};
    }
    return wake_ns;
}

static int wait_for_work(struct pollfd *set, uint64_t now_ns, uint64_t wake_ns) {
    uint64_t wait_ns = wake_ns > now_ns ? wake_ns - now_ns : 0;
    struct timespec timeout = {.tv_sec = (time_t)(wait_ns / NS_PER_S), .tv_nsec = (long)(wait_ns % NS_PER_S)};
    int ready = ppoll(set, POLL_SIZE, wake_ns == HUB_NEVER ? NULL : &timeout, NULL);
    return ready < 0 && errno != EINTR ? errno : 0;
}

// Reads come first, then new connections: a client that connected before a frame was sent gets that frame.
static void work(struct hub_loop *loop, const struct pollfd *set, uint64_t now_ns) {
    struct hub *hub = &loop->hub;
    eventfd_t woken;
    if (set[AT_WAKE].revents)
        eventfd_read(loop->wake_fd, &woken);
    for (int i = 0; i < HUB_CLIENTS; i++) {
        short events = set[AT_CLIENTS + i].revents;
        if (events & POLLIN)
            read_client(loop, i, now_ns);
        if (events & (POLLHUP | POLLERR))
            hub_leave(hub, i, now_ns);
        if (events & POLLOUT)
            loop->output_blocked[i] = false;
    }
    if (now_ns >= loop->accept_ns)
        accept_clients(loop, now_ns);
    hub_run(hub, now_ns);
    for (int i = 0; i < HUB_CLIENTS; i++)
        if (hub->clients[i].state == HUB_PRESENT && !loop->output_blocked[i])
            write_client(loop, i, now_ns);
    release_finished(loop);
}

static bool request_precision(void) {
    prctl(PR_SET_NAME, "virtual-can");
    prctl(PR_SET_TIMERSLACK, 1); // ns; the default of 50 µs is half a frame
    const struct sched_param priority = {.sched_priority = REALTIME_PRIORITY};
    return pthread_setschedparam(pthread_self(), SCHED_FIFO, &priority) == 0;
}

int hub_loop_run(struct hub_loop *loop) {
    struct pollfd set[POLL_SIZE];
    int error = 0;
    pthread_mutex_lock(&loop->mutex);
    loop->realtime = request_precision();
    uint64_t now_ns = monotonic_ns();
    do {
        uint64_t wake_ns = fill_poll_set(loop, set, now_ns);
        bool on_wire = loop->hub.on_wire >= 0;
        pthread_mutex_unlock(&loop->mutex);
        error = wait_for_work(set, now_ns, wake_ns);
        pthread_mutex_lock(&loop->mutex);
        now_ns = monotonic_ns();
        if (on_wire && now_ns > wake_ns && now_ns - wake_ns > loop->late_ns_max)
            loop->late_ns_max = now_ns - wake_ns;
        if (error == 0)
            work(loop, set, now_ns);
    } while (error == 0 && !loop->stopping);
    pthread_mutex_unlock(&loop->mutex);
    return error;
}

void hub_loop_report(struct hub_loop *loop, struct hub_report *report) {
    pthread_mutex_lock(&loop->mutex);
    report->counters = loop->hub.counters;
    memcpy(report->rules, loop->hub.faults.counters, sizeof(report->rules));
    report->late_ns_max = loop->late_ns_max;
    report->realtime = loop->realtime;
    report->client_count = 0;
    for (int i = 0; i < HUB_CLIENTS; i++)
        if (loop->fds[i] >= 0) {
            struct hub_client_report *client = &report->clients[report->client_count++];
            client->place = i;
            client->counters = loop->hub.clients[i].counters;
        }
    pthread_mutex_unlock(&loop->mutex);
}
