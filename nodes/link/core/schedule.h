// SPDX-License-Identifier: Apache-2.0
// Budget and order of one bus, sans-IO: which classes may send now, which of two offers goes first, and how
// much may wait in the kernel. The owner provides memory and time.
//
// The budget is time on the line: a frame costs its true bits, counted in ns. Credit accrues at the ceiling
// (a share of the bit rate), and everything on the bus, sent or received, is deducted from it.
//
// - Motion whose time has come may always be sent; what it overdraws, the others lack.
// - Control, and motion sent ahead, may overdraw by up to OVERDRAFT_NS, so that a query never waits for data.
// - Bulk is sent only while there is credit, which is capped at about one block: no bursts.
//
// Sending ahead below the ceiling keeps the acknowledgements of nodes possible: the host's frames to a node
// win arbitration over the frames of all nodes with a higher id, which could never answer a host that never
// pauses. Where motion is urgent and there are no other pauses, schedule_pause() makes them.
//
// Received data and motion may use the whole line for any time. Therefore each of the other classes has a
// share of its own that no other can use (CONTROL_SHARE, BULK_SHARE).
#ifndef LINK_SCHEDULE_H
#define LINK_SCHEDULE_H

#include "nodes/link/core/link.h"

// cffi: begin
enum {
    SCHEDULE_SLOTS = 11, // of 100 ms: ten complete ones and the current one
    SCHEDULE_FLOWS = 6,  // what was sent, by enum link_class; then:
    SCHEDULE_ACKS = 3,   // received: acknowledgements without content
    SCHEDULE_DATA = 4,   // received: everything else
    SCHEDULE_WEAK = 5,   // received: of ids above all of ours, with lower priority
};

// All fields are read only for users.
struct schedule {
    uint32_t bitrate; // 0: unknown or unlimited, everything may be sent
    uint32_t queue_frames;
    uint32_t unit_bits; // of a frame, or of a serial line's byte
    uint64_t ceiling_ppm;
    int64_t credit_ns;
    int64_t share_ns[LINK_CLASSES]; // guaranteed to a class and not yet used
    int64_t block_ns;               // duration of a full block
    uint64_t now_ns, begun_ns;      // last refill; the start
    uint8_t serial;                 // each direction has its own line
    uint64_t line_free_ns;          // when everything passed to the kernel will have been sent, as estimated
    uint64_t pause_ns, paused_ns;   // end of the current pause; end of the last pause
    uint64_t held_ns;               // time for which the budget delayed something
    uint64_t held_since_ns;         // 0: it delays nothing now
    uint64_t sent_bits[LINK_CLASSES], received_bits;
    uint64_t slot; // number of the current slot
    uint64_t slots[SCHEDULE_SLOTS][SCHEDULE_FLOWS];
};

// BITRATE 0: nothing is budgeted. CEILING 0 and QUEUE_FRAMES 0: the defaults. A SERIAL line counts bytes
// where CAN counts frames, and its queue is bounded only on request: the node's receive window bounds it.
void schedule_init(struct schedule *schedule, uint32_t bitrate, double ceiling, uint32_t queue_frames,
                   int serial, uint64_t now);

// Advances time, which adds credit. NOW never steps back.
void schedule_advance(struct schedule *schedule, uint64_t now);

// Returns the set of classes that may send now (see LINK_ALL).
unsigned schedule_allowed(const struct schedule *schedule);

// Returns when a class that may not send now may send again, if nothing else is sent or received.
uint64_t schedule_opens_at(const struct schedule *schedule, enum link_class kind);

// Records that BITS were passed to the kernel, or received, now. FLOW: SCHEDULE_ACKS, _DATA or _WEAK.
void schedule_sent(struct schedule *schedule, enum link_class kind, uint32_t bits);
void schedule_received(struct schedule *schedule, unsigned flow, uint32_t bits);

// Records whether the budget delays something from now on.
void schedule_held(struct schedule *schedule, int held);

// Returns whether to pause sending now, so that frames of others get through, until schedule_room_at(). An
// acknowledgement has been outstanding since SINCE_NS.
int schedule_pause(struct schedule *schedule, uint64_t since_ns);

// Returns how many frames wait, when the kernel reports QUEUED (UINT64_MAX: unknown).
uint64_t schedule_queued(const struct schedule *schedule, uint64_t queued);

// Returns how many frames may be passed on when QUEUED wait in the kernel (UINT64_MAX: unknown, estimated).
uint64_t schedule_room(const struct schedule *schedule, uint64_t queued);

// Returns when the frames of a full queue should have been sent, but for a few, or a pause ends.
uint64_t schedule_room_at(const struct schedule *schedule);

// Returns whether offer A goes before B at NOW. Overdue offers other than motion rank equally.
int schedule_before(const struct link_offer *a, const struct link_offer *b, uint64_t now);

// Return the bits of a flow within the last second; the share of the line left for motion, 0.02..ceiling.
uint64_t schedule_recent(const struct schedule *schedule, unsigned flow);
double schedule_left_for_motion(const struct schedule *schedule);
// cffi: end

#endif
