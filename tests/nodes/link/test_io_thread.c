// SPDX-License-Identifier: Apache-2.0
// sources: firmware/wire/*.c nodes/link/core/*.c nodes/link/io/*.c nodes/support/can_bits.c
// The thread of a bus between several calling threads and a node that answers as fast as it can. Also built
// by hand with -fsanitize=thread: what the mutex guards, it guards.
#include "tests/check.h"

#include <fcntl.h>
#include <poll.h>
#include <pthread.h>
#include <sys/socket.h>

#include "bench/acker.h"
#include "nodes/link/core/batch.h"
#include "nodes/link/io/io_thread.h"

enum { CALLERS = 3, COMMANDS = 3000, NODE = 4 };

struct scene {
    struct io_thread *thread;
    struct io_bus *bus;
    uint32_t link;
};

static void *serve(void *argument) {
    acker_run(argument);
    return NULL;
}

static void *call(void *argument) {
    const struct scene *scene = argument;
    uint8_t batch[BATCH_HEADER + 6], query[] = {2, 5};
    struct io_link_stats stats;
    struct io_stats bus_stats;
    size_t size = batch_write(batch, 0, 0, (const uint8_t *)"\1\2\3\4\5\6", 6);
    for (int i = 0; i < COMMANDS; i++) {
        if (i % 10) {
            CHECK_EQUAL(io_send_batch(scene->bus, scene->link, batch, size), IO_OK);
        } else {
            CHECK_EQUAL(io_set_clock(scene->bus, scene->link, 1e6, 1000, 0), IO_OK);
            while (io_send(scene->bus, scene->link, LINK_CONTROL, query, sizeof query, 0, 0) == IO_FULL)
                ;
            CHECK_EQUAL(io_get_link_stats(scene->bus, scene->link, &stats), IO_OK);
            io_get_stats(scene->bus, &bus_stats);
        }
    }
    return NULL;
}

// Takes events until the wanted notice comes; returns how many responses came before it.
static size_t take_until(struct io_thread *thread, enum io_notice wanted) {
    static struct io_event events[64];
    size_t responses = 0;
    for (;;) {
        struct pollfd fd = {.fd = io_notice_fd(thread), .events = POLLIN};
        CHECK(poll(&fd, 1, 20000) == 1);
        size_t taken = io_take(io_thread_bus(thread), events, 64);
        for (size_t i = 0; i < taken; i++) {
            responses += events[i].notice == IO_RESPONSE;
            if (events[i].notice == wanted)
                return responses;
        }
    }
}

static void converse(enum io_kind kind) {
    int fds[2];
    CHECK_EQUAL(socketpair(AF_UNIX, kind == IO_CAN_PACKET ? SOCK_SEQPACKET : SOCK_STREAM, 0, fds), 0);
    CHECK_EQUAL(fcntl(fds[0], F_SETFL, O_NONBLOCK), 0);
    struct acker acker = {.fd = fds[1], .can = kind != IO_BYTES};
    pthread_t server, callers[CALLERS];
    CHECK_EQUAL(pthread_create(&server, NULL, serve, &acker), 0);
    struct io_settings line = {0};
    struct scene scene = {.thread = io_start(fds[0], kind, &line)};
    scene.bus = io_thread_bus(scene.thread);
    struct link_settings settings = {.receive_window = 192, .lost_after_ns = 20000000000};
    CHECK_EQUAL(io_open_link(scene.bus, kind == IO_BYTES ? 0 : NODE, &settings, &scene.link), IO_OK);
    for (int i = 0; i < CALLERS; i++)
        CHECK_EQUAL(pthread_create(callers + i, NULL, call, &scene), 0);
    for (int i = 0; i < CALLERS; i++)
        CHECK_EQUAL(pthread_join(callers[i], NULL), 0);
    CHECK_EQUAL(io_watch_drained(scene.bus, scene.link), IO_OK);
    take_until(scene.thread, IO_DRAINED);
    // The node answers blocks that begin with a question. Among those of all callers there may be none.
    const uint8_t query[] = {2, 5};
    CHECK_EQUAL(io_send(scene.bus, scene.link, LINK_CONTROL, query, sizeof query, 0, 0), IO_OK);
    CHECK_EQUAL(io_watch_drained(scene.bus, scene.link), IO_OK);
    CHECK_EQUAL(take_until(scene.thread, IO_DRAINED), 1);
    struct io_link_stats stats;
    CHECK_EQUAL(io_get_link_stats(scene.bus, scene.link, &stats), IO_OK);
    CHECK_EQUAL(stats.link.commands_sent, CALLERS * COMMANDS + 1);
    CHECK_EQUAL(stats.link.bytes_invalid, 0);
    // A computer that stands still for longer than a timeout has blocks repeated; the node takes each once.
    CHECK(stats.link.blocks_repeated == 0 || stats.link.timeouts > 0);
    shutdown(fds[1], SHUT_RDWR);
    take_until(scene.thread, IO_ENDED);
    CHECK_EQUAL(io_send(scene.bus, scene.link, LINK_CONTROL, (const uint8_t *)"\4", 1, 0, 0), IO_CLOSED);
    io_stop(scene.thread);
    CHECK_EQUAL(pthread_join(server, NULL), 0);
    close(fds[0]);
    close(fds[1]);
}

int main(void) {
    converse(IO_BYTES);
    converse(IO_CAN_STREAM);
    return 0;
}
