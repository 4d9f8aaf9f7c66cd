// SPDX-License-Identifier: Apache-2.0
// Four nodes (ids 4..7) on one connection to a virtual bus: they acknowledge, and send full blocks of sensor
// data at the rate asked for. Arguments: socket, blocks per second.
#include <poll.h>
#include <stdio.h>
#include <stdlib.h>
#include <sys/socket.h>
#include <sys/un.h>
#include <time.h>

#include "bench/acker.h"

enum { NODES = 4, FIRST = 4 };

static double seconds(void) {
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    return (double)now.tv_sec + (double)now.tv_nsec * 1e-9;
}

static int connect_to(const char *path) {
    struct sockaddr_un address = {.sun_family = AF_UNIX};
    snprintf(address.sun_path, sizeof address.sun_path, "%s", path);
    int fd = socket(AF_UNIX, SOCK_STREAM, 0);
    return connect(fd, (struct sockaddr *)&address, sizeof address) ? -1 : fd;
}

// Returns 0 at the end of the connection.
static int take_frames(struct acker *nodes, int fd) {
    struct can_frame frames[64];
    static size_t rest;
    ssize_t size = read(fd, (uint8_t *)frames + rest, sizeof frames - rest);
    if (size <= 0)
        return 0;
    size_t used = rest + (size_t)size, count = used / sizeof *frames;
    for (size_t i = 0; i < count; i++) {
        uint32_t nodeid = (frames[i].can_id - 0x100) / 2;
        if (nodeid >= FIRST && nodeid < FIRST + NODES && !(frames[i].can_id & 1))
            acker_take(&nodes[nodeid - FIRST], frames[i].can_id, frames[i].data, frames[i].can_dlc);
    }
    rest = used % sizeof *frames;
    memmove(frames, (uint8_t *)frames + count * sizeof *frames, rest);
    for (size_t i = 0; i < NODES; i++)
        acker_flush(&nodes[i]);
    return 1;
}

int main(int argc, char **argv) {
    static struct acker nodes[NODES];
    int fd = argc == 3 ? connect_to(argv[1]) : -1;
    if (fd < 0)
        return 1;
    for (size_t i = 0; i < NODES; i++)
        nodes[i] = (struct acker){.fd = fd, .can = 1};
    double rate = atof(argv[2]), start_s = seconds();
    uint64_t sent = 0;
    uint8_t content[WIRE_CONTENT_MAX] = {3, 7};
    for (;;) {
        struct pollfd ready = {.fd = fd, .events = POLLIN};
        if (poll(&ready, 1, 1) > 0 && !take_frames(nodes, fd))
            return 0;
        for (uint64_t due = (uint64_t)((seconds() - start_s) * rate); sent < due; sent++) {
            content[2] = (uint8_t)sent;
            acker_answer(&nodes[sent % NODES], 0x100 + 2 * (FIRST + (uint32_t)(sent % NODES)), content,
                         sizeof content);
            acker_flush(&nodes[sent % NODES]);
        }
    }
}
