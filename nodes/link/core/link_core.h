// SPDX-License-Identifier: Apache-2.0
// Internals of the link, shared by its files: link.c sends, link_pack.c fills blocks, link_receive.c
// receives.
#ifndef LINK_CORE_H
#define LINK_CORE_H

#include "nodes/link/core/link.h"

#define NS_PER_S 1000000000ULL
#define NS_PER_MS 1000000ULL

// Sync bytes in front of a repeat (they are legal anywhere before a block). A node that lost the end of a
// block takes the following bytes for the missing ones, finds a wrong checksum and drops everything to the
// next 0x7E: without a 0x7E before it, the repeat itself would be dropped, which costs another round trip.
// This holds on CAN and on a UART, so every repeat gets one. After a timeout the node may still be waiting
// for up to 59 bytes of a block whose length byte was damaged, and would swallow short repeats one by one;
// LEAD_FLUSH pads the repeat so that it cannot wait longer.
enum lead_in { LEAD_NONE, LEAD_SYNC, LEAD_FLUSH };

static inline struct link_block *block_of(struct link *link, uint64_t sequence) {
    return &link->blocks[sequence % LINK_SLOTS];
}

static inline const struct link_block *const_block_of(const struct link *link, uint64_t sequence) {
    return &link->blocks[sequence % LINK_SLOTS];
}

// Returns the host time at which the node's clock reads TICKS, saturated. The clock must be known.
uint64_t link_clock_to_ns(const struct link *link, uint64_t ticks);

// Starts to transmit everything from the first unacknowledged block on again.
void link_rewind(struct link *link, uint64_t now, enum lead_in lead_in);

// Returns the host time at which the earliest command is due that is not acknowledged or waits at the front
// of the motion queue; 0: none is due, or the clock is unknown.
uint64_t link_due(const struct link *link);

// Returns how long an answer may take, without the reserve of link_first_rto() for a busy host.
uint64_t link_answer_time(const struct link *link);

// The timeout without doublings.
uint64_t link_first_rto(const struct link *link);

// The timeout in use: from the round trip, doubled for each timeout since the last measurement.
uint64_t link_rto(const struct link *link);

// Returns when an incomplete block in the receive buffer is given up; LINK_NEVER without one.
uint64_t link_partial_deadline(const struct link *link);

// Returns whether BYTES more fit into the node's receive window. With nothing in flight they always do: no
// answer would come that makes room.
static inline int link_fits(const struct link *link, size_t bytes) {
    uint64_t unread = link->in_flight_bytes + link->late_bytes;
    return link->in_flight_bytes == 0 || unread + bytes <= link->settings.receive_window;
}

// Returns from when on a command that is due at REQ_CLOCK is not too far ahead. Motion: in steps of a quarter
// of that time, so that a thread that wakes for some of it sends much at once. The clock must be known.
uint64_t link_near_at(const struct link *link, enum link_class kind, uint64_t req_clock);

// The records at the front of a queue that may be sent now and fit together.
struct link_front {
    uint64_t end;     // position behind them
    size_t size;      // of their payloads
    uint64_t gate_ns; // when the next one may be sent; LINK_NEVER: there is none, or it does not fit
};

// The next new block.
struct link_plan {
    uint64_t at_ns;          // when the next new block may be sent; <= NOW: the clocks allow it now
    struct link_offer offer; // of its first command
    struct link_front fronts[LINK_CLASSES];
    enum link_class order[LINK_CLASSES];
    size_t classes; // number of them that have something to send
    size_t size;    // of all fronts
};

struct link_plan link_plan_block(const struct link *link, uint64_t now, unsigned allowed);

// Returns whether clocks, sequence and window allow to send it.
int link_may_go(const struct link *link, const struct link_plan *plan, uint64_t now);

// Moves the planned commands of a class to BLOCK.
void link_take(struct link *link, enum link_class kind, const struct link_front *front,
               struct link_block *block);

#endif
