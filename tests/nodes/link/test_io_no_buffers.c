// SPDX-License-Identifier: Apache-2.0
// sources: firmware/wire/*.c nodes/link/core/*.c nodes/link/io/*.c nodes/support/can_bits.c
// SocketCAN's ENOBUFS: a full interface queue costs time, no frame and no busy loop. The kernels of build
// machines have no CAN, so the one call that tells it is replaced: this file's write() refuses first.
#define _GNU_SOURCE
#include "tests/check.h"

#include <errno.h>
#include <fcntl.h>
#include <poll.h>
#include <pthread.h>
#include <stdatomic.h>
#include <sys/socket.h>
#include <sys/syscall.h>

#include "bench/acker.h"
#include "nodes/link/io/io_thread.h"

enum { REFUSALS = 200, QUERIES = 50 };

static atomic_int refused_fd = -1, refusals;

ssize_t write(int fd, const void *data, size_t size) {
    if (fd == atomic_load(&refused_fd) && atomic_fetch_sub(&refusals, 1) > 0) {
        errno = ENOBUFS;
        return -1;
    }
    return syscall(SYS_write, fd, data, size);
}

static void *serve(void *argument) {
    acker_run(argument);
    return NULL;
}

static void await_responses(struct io_thread *thread, int wanted) {
    struct io_event events[16];
    while (wanted > 0) {
        struct pollfd fd = {.fd = io_notice_fd(thread), .events = POLLIN};
        CHECK(poll(&fd, 1, 20000) == 1);
        size_t taken = io_take(io_thread_bus(thread), events, 16);
        for (size_t i = 0; i < taken; i++)
            wanted -= events[i].notice == IO_RESPONSE;
    }
    CHECK_EQUAL(wanted, 0);
}

int main(void) {
    int fds[2];
    CHECK_EQUAL(socketpair(AF_UNIX, SOCK_STREAM, 0, fds), 0);
    CHECK_EQUAL(fcntl(fds[0], F_SETFL, O_NONBLOCK), 0);
    struct acker acker = {.fd = fds[1], .can = 1};
    pthread_t server;
    CHECK_EQUAL(pthread_create(&server, NULL, serve, &acker), 0);
    struct io_settings line = {.bitrate = 1000000};
    struct io_thread *thread = io_start(fds[0], IO_CAN_STREAM, &line);
    struct io_bus *bus = io_thread_bus(thread);
    struct link_settings settings = {.receive_window = 192, .lost_after_ns = 20000000000};
    uint32_t link;
    CHECK_EQUAL(io_open_link(bus, 4, &settings, &link), IO_OK);
    uint8_t query[30] = {2};
    for (int round = 0; round < QUERIES; round++) {
        atomic_store(&refusals, round == 10 ? REFUSALS : round % 4);
        atomic_store(&refused_fd, fds[0]);
        CHECK_EQUAL(io_send(bus, link, LINK_CONTROL, query, sizeof query, 0, 0), IO_OK);
        await_responses(thread, 1);
    }
    struct io_stats stats;
    struct io_link_stats link_stats;
    io_get_stats(bus, &stats);
    CHECK_EQUAL(io_get_link_stats(bus, link, &link_stats), IO_OK);
    CHECK_EQUAL(link_stats.link.commands_sent, QUERIES);
    CHECK_EQUAL(link_stats.link.bytes_invalid, 0);
    CHECK_EQUAL(acker.expected, (link_stats.link.blocks_sent - link_stats.link.blocks_repeated) % 16);
    CHECK(stats.waits >= REFUSALS);
    // Each refusal is one sleep; each block, sent once or again after a standstill, a few wake-ups.
    CHECK(stats.wakeups < 2 * stats.waits + 20 * (QUERIES + link_stats.link.blocks_repeated));
    io_stop(thread);
    shutdown(fds[1], SHUT_RDWR);
    CHECK_EQUAL(pthread_join(server, NULL), 0);
    close(fds[0]);
    close(fds[1]);
    return 0;
}
