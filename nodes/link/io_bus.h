// SPDX-License-Identifier: Apache-2.0
// The inside of an I/O thread, shared by io_thread.c (thread, events), io_links.c (what is asked of links),
// io_transfer.c (bytes and frames) and io_schedule.c (whose turn it is); not for others. Every function here
// wants the mutex held.
#ifndef LINK_IO_BUS_H
#define LINK_IO_BUS_H

#include <linux/can.h>
#include <pthread.h>

#include "nodes/link/io_thread.h"
#include "nodes/link/link.h"

struct io_link {
    struct link link;
    uint32_t number; // never used twice on a bus; 0: none
    uint8_t nodeid;
    uint8_t lost_pending;  // an IO_LOST is due
    uint8_t lost_told;     // and was given
    uint8_t watch_drained; // an IO_DRAINED was asked for
    uint8_t drained_pending;
    uint8_t control_memory[IO_CONTROL_BYTES];
    uint8_t motion_memory[IO_MOTION_BYTES];
};

// A bounded ring that drops its oldest entry when full.
struct io_ring {
    struct io_event *events;
    size_t size, first, count;
};

struct io_bus {
    int fd, wake_fd, notice_fd;
    enum io_kind kind;
    pthread_t thread;
    pthread_mutex_t mutex;
    uint8_t stopping;
    uint8_t sleeping;      // the thread sleeps, or is about to
    uint8_t noticed;       // notice_fd is readable
    uint8_t ended;         // the transport is of no more use
    uint8_t ended_pending; // an IO_ENDED is due
    int32_t ended_errno;
    uint32_t last_number;
    uint64_t sleep_until_ns; // when the sleeping thread wakes by itself
    size_t turn;             // link after the one that was served last
    size_t link_count;
    struct io_link *links[IO_LINKS_MAX];
    struct io_link *by_nodeid[256];
    struct io_ring responses, unclaimed;
    struct can_frame admin[IO_ADMIN_MAX]; // to be sent
    size_t admin_first, admin_count;
    uint8_t out[IO_OUT_FRAMES * sizeof(struct can_frame)]; // bytes for the kernel: frames, or a serial line's
    size_t out_at, out_size;
    uint8_t in[64 * sizeof(struct can_frame)];
    size_t in_used;      // IO_CAN_STREAM: bytes of a frame that is not complete
    uint64_t retry_ns;   // the kernel has no buffers; try again then. 0: it has
    uint8_t kernel_full; // wait until the descriptor is writable
    struct io_stats stats;
};

// io_transfer.c: read all there is; write all that may go.
void io_read_all(struct io_bus *bus, uint64_t now);
void io_write_all(struct io_bus *bus, uint64_t now);
void io_deliver(struct io_bus *bus, struct io_link *node, const uint8_t *data, size_t size, uint64_t now);
void io_end(struct io_bus *bus, int cause);
void io_notify(struct io_bus *bus);

// io_thread.c: notes what Python has to hear of; sends from the caller's thread what was queued.
void io_note_states(struct io_bus *bus);
void io_send_now(struct io_bus *bus);

// io_schedule.c: the link that shall send its next block now, or NULL; and that it did.
struct io_link *io_next_link(const struct io_bus *bus, uint64_t now);
void io_served(struct io_bus *bus, const struct io_link *node);

#endif
