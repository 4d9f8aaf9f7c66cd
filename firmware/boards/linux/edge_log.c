// SPDX-License-Identifier: Apache-2.0
// The edge log: what the outputs truly did and when.
//
// A header of 64 bytes, then one little-endian u64 per change: clock (48 bits) << 16 | pin << 1 | level.
// Header: "CNDEDGE1", f64 nominal clock frequency, f64 true ticks per second of CLOCK_MONOTONIC, u64
// CLOCK_MONOTONIC at start in ns, u64 clock at start, zeros.
#include "boards/linux/linux.h"

#include <errno.h>
#include <fcntl.h>
#include <stdio.h>
#include <string.h>
#include <unistd.h>

enum { HEADER_SIZE = 64 };

static void write_all(struct linux_board *board, const void *data, size_t size) {
    const uint8_t *at = data;
    while (size && board->edge_fd >= 0) {
        ssize_t done = write(board->edge_fd, at, size);
        if (done < 0 && errno == EINTR)
            continue;
        if (done < 0) {
            fprintf(stderr, "cannot write the edge log %s: %s; it ends here\n", board->options.edge_log,
                    strerror(errno));
            close(board->edge_fd);
            board->edge_fd = -1;
            return;
        }
        at += done;
        size -= (size_t)done;
    }
}

int edge_log_open(struct linux_board *board) {
    board->virtual.edges = board->edge_buffer;
    board->virtual.edge_room = EDGE_BUFFER;
    board->edge_fd = -1;
    if (!board->options.edge_log)
        return 0;
    board->edge_fd = open(board->options.edge_log, O_WRONLY | O_CREAT | O_TRUNC | O_CLOEXEC, 0644);
    if (board->edge_fd < 0) {
        fprintf(stderr, "cannot write the edge log %s: %s\n", board->options.edge_log, strerror(errno));
        return -1;
    }
    uint8_t header[HEADER_SIZE] = "CNDEDGE1";
    double nominal = virtual_variant.clock_freq;
    memcpy(header + 8, &nominal, 8);
    memcpy(header + 16, &board->rate, 8);
    memcpy(header + 24, &board->start_ns, 8);
    memcpy(header + 32, &board->start_clock, 8);
    write_all(board, header, sizeof(header));
    return 0;
}

void virtual_edges_full(struct virtual_board *virtual) {
    write_all((struct linux_board *)virtual, virtual->edges, virtual->edge_count * sizeof(uint64_t));
    virtual->edge_count = 0;
}

void edge_log_close(struct linux_board *board) {
    virtual_edges_full(&board->virtual);
    if (board->edge_fd >= 0)
        close(board->edge_fd);
    board->edge_fd = -1;
}
