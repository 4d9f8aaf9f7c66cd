// SPDX-License-Identifier: Apache-2.0
// A node as a Linux process. Its clock is CLOCK_MONOTONIC at an adjustable rate and offset.
//
// The kernel wakes a process late. Firmware on a chip must not see that: while timers are dispatched, the
// clock reads each timer's own waketime, in order, until the real time is reached (an infinitely fast chip).
// Tasks and commands see real time, so that a command which comes too late is too late here as well.
#ifndef BOARDS_LINUX_H
#define BOARDS_LINUX_H

#include "boards/virtual/virtual.h"
#include "net/can_stream.h"

#include <stdio.h>

enum link_kind { LINK_NONE, LINK_VIRTUAL_CAN, LINK_SOCKETCAN, LINK_UART };

enum { EDGE_BUFFER = 8192, OUT_BUFFER = 65536, IN_BUFFER = 4096 };

struct options {
    enum link_kind link;
    const char *target; // socket path, interface, or the link to make to the pseudo-terminal
    const char *edge_log;
    const char *plant;
    uint8_t uuid[NODE_UUID_SIZE];
    double rate_ppm;
    uint64_t start_clock, jitter_us, slice_us, seed, legacy, plant_log;
};

struct linux_board {
    struct virtual_board virtual;
    struct can_stream can;
    struct options options;

    double rate; // ticks per second of CLOCK_MONOTONIC
    uint64_t start_ns, start_clock;
    uint64_t dispatch_clock; // what the firmware sees while dispatching
    uint8_t dispatching, reset_wanted, closed;
    uint8_t failed;  // closed, and that is not how it should end
    uint8_t refused; // the node has more to say than `out` could take

    uint8_t filtered_id; // for which SocketCAN lets frames pass; 0: all

    int fd, slave_fd, edge_fd;
    uint8_t out[OUT_BUFFER]; // waiting for the descriptor; whole frames on CAN
    size_t out_size;
    uint64_t retry_ns;     // when an interface that took no frame is tried again; 0: poll() tells
    uint8_t in[IN_BUFFER]; // read, not yet given to the node; a partial frame stays
    size_t in_size;
    uint64_t random;

    uint64_t bytes_in, bytes_out, frames_in, frames_out, resets;
    uint64_t late_sum, late_count, late_max; // ticks by which timers were dispatched late

    struct plant plant;                   // virtual.plant points to it when there is one
    FILE *plant_log;                      // null: none is wanted
    uint64_t plant_update_ns;             // when it is due
    uint64_t plant_given_up[PLANT_PEERS]; // the horizon at which we waited in vain
    uint64_t plant_waits, plant_misses;

    uint64_t edge_buffer[EDGE_BUFFER];
    _Alignas(16) uint8_t arena[256 * 1024];
};

// options.c: returns 0, or the exit status after one sentence on stderr.
int options_parse(struct options *options, int argc, char **argv);

// clock.c
uint64_t monotonic_ns(void);
uint64_t clock_at(const struct linux_board *board, uint64_t ns);
uint64_t ns_of_clock(const struct linux_board *board, uint64_t clock);

// link.c. link_open returns 0, or -1 after one sentence on stderr.
int link_open(struct linux_board *board);
void link_close(struct linux_board *board);
// Reads what is there; link_hand_over gives it to the node, running its tasks as it goes.
void link_read(struct linux_board *board);
void link_hand_over(struct linux_board *board);
void link_flush(struct linux_board *board);

// plant.c. linux_plant_open returns 0, or -1 after one sentence on stderr.
int linux_plant_open(struct linux_board *board);
void linux_plant_close(struct linux_board *board);
// Keeps page and log up to date; returns when it wants to do so next.
uint64_t linux_plant_update(struct linux_board *board, uint64_t now);
// No step will be made before NS.
void linux_plant_horizon(struct linux_board *board, uint64_t ns);

// edge_log.c. edge_log_open returns 0, or -1 after one sentence on stderr.
int edge_log_open(struct linux_board *board);
void edge_log_close(struct linux_board *board);

#endif
