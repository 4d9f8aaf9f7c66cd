// SPDX-License-Identifier: Apache-2.0
// The budget and the order of one bus, sans-IO: which classes may send now, which of two offers goes first,
// and how much may sit in the kernel. The owner provides memory and time.
//
// Time on the line is the currency: a frame costs its true bits, counted in ns. Credit comes in at the
// ceiling (a share of the bit rate) and everything that is on the bus, sent or received, is paid from it.
//     motion   whose time has come always may go, and what it overdraws the others lack; sent ahead, as
//     control control  overdraws by up to OVERDRAFT_NS, so that a question never waits for data bulk     only
//     while there is credit, which is capped at about one block: no bursts
// Sending ahead below the ceiling is what keeps the nodes' acknowledgements alive: the host's frames to a
// node win arbitration over the frames of all nodes with a higher id, and a host that never pauses is never
// answered by those. Where motion is urgent and there are no pauses by themselves, schedule_pause() makes
// them.
//
// Received data and motion may take all there is for ever. So that the others get through nevertheless, each
// has a share of its own that nobody else can spend (CONTROL_SHARE, BULK_SHARE).
#ifndef LINK_SCHEDULE_H
#define LINK_SCHEDULE_H

#include "nodes/link/link.h"

// cffi: begin
enum {
    SCHEDULE_SLOTS = 11, // of 100 ms: ten whole ones and the one that is being filled
    SCHEDULE_FLOWS = 6,  // what was sent, by enum link_class; then:
    SCHEDULE_ACKS = 3,   // received: acknowledgements without content
    SCHEDULE_DATA = 4,   // received: everything else
    SCHEDULE_WEAK = 5,   // received: of ids so high that it gives way to all of ours
};

// All fields are the scheduler's own, but for reading.
struct schedule {
    uint32_t bitrate; // 0: unknown or unlimited, everything may go
    uint32_t queue_frames;
    uint32_t unit_bits; // of a frame, or of a serial line's byte
    uint64_t ceiling_ppm;
    int64_t credit_ns;
    int64_t share_ns[LINK_CLASSES]; // guaranteed to a class and not yet used
    int64_t block_ns;               // what a full block lasts
    uint64_t now_ns, begun_ns;      // last refill; the start
    uint8_t serial;                 // each direction has a line of its own
    uint64_t line_free_ns;          // when all that was handed over will have left, as far as is known
    uint64_t pause_ns, paused_ns;   // the line is left alone until then; when it last was
    uint64_t held_ns;               // time for which the budget held something back
    uint64_t held_since_ns;         // 0: it does not, now
    uint64_t sent_bits[LINK_CLASSES], received_bits;
    uint64_t slot; // number of the slot that is being filled
    uint64_t slots[SCHEDULE_SLOTS][SCHEDULE_FLOWS];
};

// BITRATE 0: nothing is budgeted. CEILING 0 and QUEUE_FRAMES 0: the defaults. A SERIAL line counts bytes
// where CAN counts frames, and its queue is bounded only if asked for: the node's receive window does it.
void schedule_init(struct schedule *schedule, uint32_t bitrate, double ceiling, uint32_t queue_frames,
                   int serial, uint64_t now);

// Lets time pass: refills. NOW never steps back.
void schedule_advance(struct schedule *schedule, uint64_t now);

// The set of classes that may send now (see LINK_ALL).
unsigned schedule_allowed(const struct schedule *schedule);

// When a class that may not send now may again, if nothing else is sent or received.
uint64_t schedule_opens_at(const struct schedule *schedule, enum link_class kind);

// Something of BITS was handed over, or was received, now. FLOW: SCHEDULE_ACKS, _DATA or _WEAK.
void schedule_sent(struct schedule *schedule, enum link_class kind, uint32_t bits);
void schedule_received(struct schedule *schedule, unsigned flow, uint32_t bits);

// The budget holds something back from now on, or holds nothing.
void schedule_held(struct schedule *schedule, int held);

// An acknowledgement is awaited since SINCE. Returns whether the line has to be left alone now, so that
// frames of others get through; until when tells schedule_room_at().
int schedule_pause(struct schedule *schedule, uint64_t since_ns);

// How many frames wait, when QUEUED are said to sit in the kernel (UINT64_MAX: unknown).
uint64_t schedule_queued(const struct schedule *schedule, uint64_t queued);

// How many frames may be handed over when QUEUED sit in the kernel (UINT64_MAX: unknown, it is estimated).
uint64_t schedule_room(const struct schedule *schedule, uint64_t queued);

// When a frame of a full queue should have left, or a pause ends.
uint64_t schedule_room_at(const struct schedule *schedule);

// Whether offer A goes before B when both could go at NOW. What is overdue and not motion is overdue alike.
int schedule_before(const struct link_offer *a, const struct link_offer *b, uint64_t now);

// Bits of a flow within the last second; the share of the line that is left for motion, 0.02..ceiling.
uint64_t schedule_recent(const struct schedule *schedule, unsigned flow);
double schedule_left_for_motion(const struct schedule *schedule);
// cffi: end

#endif
