// SPDX-License-Identifier: Apache-2.0
// Internals of a bus's core, shared by io_core.c (creation, notices), io_links.c (functions of links),
// io_receive.c, io_send.c (bytes and frames), io_schedule.c (order of links), io_forecast.c (lateness of
// motion) and io_stats.c (counters). Every function here requires the driver's lock.
#ifndef LINK_IO_BUS_H
#define LINK_IO_BUS_H

#include <linux/can.h>

#include "nodes/link/core/link.h"
#include "nodes/link/io/io_api.h"

enum {
    IO_FRAME_SIZE = sizeof(struct can_frame),
    IO_DATA_MAX = 8,
    IO_DATA_ID = 0x100,       // + 2 * node id: to the node
    IO_ADMIN_LAST_ID = 0x3F1, // ids above it belong to neither nodes nor host
    IO_CUT_MAX = IO_DATA_MAX - 1 + LINK_WIRE_MAX,
    IO_SEGMENTS = 512, // of queued motion, per link
};

// Motion commands that are due within a few ms of each other, for the forecast.
struct io_segment {
    uint64_t start, end;           // positions in the motion queue
    uint64_t min_clock, req_clock; // the earliest of them, node ticks
    uint32_t content;              // bytes
};

// Responses that begin with an id and may wait.
struct io_patience {
    uint8_t id[IO_ID_MAX], size;
    uint64_t wait_ns;  // for so long
    uint32_t together; // notify when so many wait; 0: not for their number
    uint32_t waiting;  // so many do, of those that came after
    uint64_t takes;    // this number of io_take()
};

// Published counters, read without a lock: SEQUENCE is odd while they are written.
struct io_snapshot {
    uint64_t sequence;
    uint64_t number; // of the link; 0: none
    struct io_link_stats stats;
};

struct io_link {
    struct link link;
    uint32_t number; // never used twice on a bus; 0: none
    uint8_t nodeid;
    uint8_t lost_pending;  // an IO_LOST is due
    uint8_t lost_reported; // and was reported
    uint8_t watch_drained; // an IO_DRAINED was requested
    uint8_t drained_pending;
    uint8_t silent_pending;  // an IO_SILENT is due
    uint64_t silences;       // of the link, that were reported
    uint8_t cut[IO_CUT_MAX]; // bytes of blocks that are being split into frames
    size_t cut_at, cut_size;
    struct link_offer cut_offer;                 // of the newest block in there
    uint8_t changed;                             // since its counters were published
    struct io_patience patience[IO_PATIENT_MAX]; // those of size 0 are free
    uint8_t in_a_hurry;                          // none of them counts now
    struct io_snapshot *snapshot;
    struct io_flow flows[LINK_CLASSES], received;
    struct io_segment segments[IO_SEGMENTS];
    size_t segment_first, segment_count;
    uint8_t control_memory[IO_CONTROL_BYTES];
    uint8_t motion_memory[IO_MOTION_BYTES];
    uint8_t bulk_memory[IO_BULK_BYTES];
};

// A bounded ring that drops its oldest entry when full.
struct io_ring {
    struct io_event *events;
    size_t size, first, count;
};

struct io_bus {
    struct io_driver driver;
    void *context;
    struct io_settings settings;
    struct schedule schedule;
    enum io_kind kind;
    unsigned allowed;                   // classes that may send, at the last io_next()
    uint64_t hold_ns;                   // when delayed data may be sent; UINT64_MAX: there is none
    double motion_bits, motion_content; // bits and bytes of motion so far, for the forecast
    uint8_t corked;                     // what io_send() queues waits
    uint8_t corked_waits;               // something does
    uint8_t noticed;                    // the driver was notified that io_take() has something
    uint64_t takes;                     // how often io_take() has returned everything
    uint64_t notice_ns;                 // when it is notified of what may wait; UINT64_MAX: nothing does
    uint8_t ended;                      // the transport has ended
    uint8_t ended_pending;              // an IO_ENDED is due
    int32_t ended_errno;
    uint32_t last_number;
    size_t turn; // the link after the one served last
    size_t link_count;
    struct io_link *links[IO_LINKS_MAX];
    struct io_link *by_nodeid[256];
    struct io_ring responses, unclaimed;
    struct can_frame admin[IO_ADMIN_MAX]; // to be sent, stops first
    size_t admin_first, admin_count;
    uint8_t rest[IO_FRAME_SIZE]; // IO_CAN_STREAM: bytes of a received frame that is not complete
    size_t rest_size;
    struct io_stats stats;
    uint64_t published_sequence;
    struct io_stats published;
    struct io_snapshot snapshots[IO_LINKS_MAX];
};

// io_core.c
void io_lock(struct io_bus *bus);
void io_unlock(struct io_bus *bus);
void io_notify(struct io_bus *bus);
// Notifies WAIT_NS after NOW, unless io_take() is called before; 0: at once.
void io_notify_by(struct io_bus *bus, uint64_t now, uint64_t wait_ns);
void io_push(struct io_ring *ring, const struct io_event *event, uint64_t *dropped, uint64_t *most);
void io_note_states(struct io_bus *bus); // records state changes that Python has to be notified of

// io_receive.c: processes bytes of one node; without bytes, only the timeout of an incomplete block.
void io_deliver(struct io_bus *bus, struct io_link *node, const uint8_t *data, size_t size, uint64_t now);

// io_schedule.c: returns the link that is to send next of the classes in ALLOWED, or NULL. The remainder of a
// block counts as an offer, except for ENDING, which is at the end of a block. *best: its offer. io_served()
// records that it was sent.
struct io_link *io_next_link(const struct io_bus *bus, uint64_t now, unsigned allowed,
                             const struct io_link *ending, struct link_offer *best);
void io_served(struct io_bus *bus, const struct io_link *node);

// Returns whether a frame of no link stops what nodes do: its id comes before those of all data.
static inline int io_is_stop(uint32_t can_id) {
    return can_id < IO_DATA_ID;
}

// Bits of a frame for the budget; 0 while the bit rate is unknown.
uint32_t io_frame_bits(const struct io_bus *bus, uint32_t can_id, const uint8_t *data, size_t size);
uint32_t io_serial_bits(const struct io_bus *bus, size_t size);

// io_forecast.c: records a batch that was added to the motion queue. Commands that leave the queue need no
// call.
void io_note_batch(struct io_link *node, const uint8_t *batch, size_t size);

// io_stats.c: publishes changed counters.
void io_publish(struct io_bus *bus);

#endif
