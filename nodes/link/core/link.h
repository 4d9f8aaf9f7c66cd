// SPDX-License-Identifier: Apache-2.0
// One node's link, host side, sans-IO: commands in, message blocks out; bytes in, responses out. The
// manual is in io_api.h.
//
// Delivery to the node is reliable and in order, answers are checked but not repeated (they may get lost;
// then the query is repeated). The owner provides memory and time: NOW is the host's CLOCK_MONOTONIC in ns
// and never steps back; clocks are the node's ticks in 64 bits. It never blocks, allocates, or reads a clock.
// Use it from one thread at a time.
//
// The owner's loop, after any event:
//     link_receive() until it returns 0, then link_handle_timer(), then link_next_block() until it returns 0
//     or the line is full, then sleep until link_deadline().
// Reading comes before the timer: an acknowledgement that waits in the kernel must not count as late.
#ifndef LINK_LINK_H
#define LINK_LINK_H

#include "nodes/link/core/queue.h"

// cffi: begin
enum {
    LINK_BLOCKS_MAX = 15,   // in flight: the 4-bit sequence cannot distinguish 16 from none
    LINK_SLOTS = 16,        // remembered blocks, by the low four bits of their sequence
    LINK_WINDOW_MIN = 64,   // smallest receive window: one complete block
    LINK_WIRE_MAX = 144,    // most bytes link_next_block writes: a block twice, with sync bytes before each
    LINK_RX_MAX = 256,      // received bytes that wait for the rest of their block
    LINK_LEAD_BUCKETS = 16, // late, < 1 ms, < 2 ms, < 4 ms, … >= 2^13 ms
    LINK_SILENCE_MS = 250,  // a node that owes an acknowledgement may have restarted
};

enum link_status {
    LINK_OK,
    LINK_FULL,    // the queue has no room; nothing was accepted
    LINK_INVALID, // empty, longer than a block's content, or an incomplete batch; nothing was accepted
    LINK_GONE,    // the link is lost
};

// Class of a command, by priority.
enum link_class {
    LINK_MOTION,  // batches: due at their req_clock
    LINK_CONTROL, // queries, configuration: soon
    LINK_BULK,    // bulk data: the remaining capacity of the bus
    LINK_CLASSES,
    LINK_ALL = (1 << LINK_CLASSES) - 1, // a set of classes has bit 1 << class for each
};

// State of a link; link_states.c has the table of transitions.
enum link_state {
    LINK_PROBING,    // the node's expected sequence is unknown: an empty block asks for it
    LINK_CONFIRMING, // it was answered; a second empty block confirms the sequence before commands are sent
    LINK_RUNNING,    // commands are sent
    LINK_LOST,       // final
    LINK_STATES,
};

// Event that changes the state of a link.
enum link_event {
    LINK_EVENT_TAKEN,   // an answer to an empty block reports the next sequence
    LINK_EVENT_REFUSED, // an answer to an empty block reports another sequence
    LINK_EVENT_SILENCE, // lost_after_ns passed without an acknowledgement
    LINK_EVENTS,
};

// Returns the state after EVENT in STATE.
enum link_state link_following(enum link_state state, enum link_event event);

enum link_cause {
    LINK_CAUSE_NONE,
    LINK_CAUSE_SILENT, // nothing was received for lost_after_ns
    LINK_CAUSE_STUCK,  // the node answers, but acknowledges nothing
};

struct link_settings {
    uint64_t receive_window; // bytes the node can buffer, >= LINK_WINDOW_MIN
    uint64_t lost_after_ns;  // time without an acknowledgement after which the link is lost; > 0
    uint64_t ahead_ns;       // motion is sent so long before it is due at most; 0: as soon as it can be
};

struct link_stats {
    uint64_t blocks_sent, bytes_sent;         // everything on the wire, repeats and sync bytes included
    uint64_t commands_sent, commands_dropped; // dropped: by link_send_urgent
    uint64_t blocks_repeated, bytes_repeated; // of blocks_sent, bytes_sent
    uint64_t naks, timeouts;                  // reasons to repeat (naks: all received ones)
    uint64_t blocks_received, bytes_received; // valid blocks; all bytes
    uint64_t bytes_invalid;                   // received bytes of no valid block
    uint64_t acks_duplicate;                  // repeated acks without new information
    uint64_t acks_never_sent;                 // acknowledgements of blocks that were not sent: ignored
    uint64_t srtt_ns, rttvar_ns, rto_ns;      // round trip; 0 until measured (rto: in use now)
    uint64_t lead_count;                      // motion commands whose lead is known
    int64_t lead_min_ns;                      // smallest lead of all; valid when lead_count > 0
    uint64_t lead_histogram[LINK_LEAD_BUCKETS];
};

// A block that was sent; valid until its slot is used again.
struct link_block {
    uint64_t sent_ns;    // last transmission
    uint8_t repeats;     // transmissions after the first, 255 at most: its round trip is ambiguous (Karn)
    uint8_t length;      // of the block
    uint8_t wire_length; // of the last transmission: with the preceding sync bytes
    uint8_t commands;
    uint8_t kind;       // enum link_class of its first command
    uint8_t asks;       // something in it is no motion, and may have an answer
    uint8_t leads;      // number of req_clocks
    uint64_t due_clock; // the earliest req_clock of its commands of all classes; 0: none has one
    uint64_t req_clock[WIRE_CONTENT_MAX];
    uint8_t bytes[WIRE_BLOCK_MAX];
};

// All fields are internal; read them through the functions.
struct link {
    struct link_settings settings;
    enum link_state state;
    enum link_cause cause;
    uint8_t urgent; // link_send_urgent's command is still queued
    struct link_queue queues[LINK_CLASSES];
    struct link_block blocks[LINK_SLOTS];
    uint64_t first, cursor, next; // first unacknowledged <= next to transmit (again) <= next new block
    uint64_t in_flight_bytes;     // transmitted since the last rewind and not acknowledged
    uint64_t late_bytes;          // of repeats acknowledged, perhaps by answers to earlier transmissions
    uint64_t in_flight_commands;  // in blocks [first, next)
    uint64_t motion_content;      // content bytes of motion commands sent so far, once each
    uint64_t progress_ns;         // last acknowledgement, or when the link stopped being idle
    uint64_t heard_ns;            // last valid block
    uint64_t silence_ns;          // when a silence was counted last
    uint64_t silences;            // repeats after LINK_SILENCE_MS, each, without a block from the node
    uint64_t last_ack;            // sequence of the last empty block
    uint64_t naks_outstanding, outstanding_until_ns,
        outstanding_until_seq; // naks that the last repeats may still cause
    uint64_t ignored_nak_ns;   // the last of these since the last rewind and progress; 0: none
    uint64_t backoff;          // doublings of the timeout
    uint8_t lead_in;           // sync bytes before the next transmission: 0, 1, or LINK_FLUSH
    double clock_hz;           // 0: unknown
    uint64_t clock_at_ns, clock_at_ticks;
    uint8_t rx[LINK_RX_MAX];
    size_t rx_used;
    uint64_t rx_ns;     // arrival of the newest byte in rx
    uint8_t rx_excused; // a late check of its incomplete block was already excused once
    struct wire_scanner scanner;
    struct link_stats stats;
};

struct link_response {
    uint64_t sent_ns;     // time at which the acknowledged block was sent; 0: repeated, or unknown
    uint64_t received_ns; // NOW of the call that completed the response
    uint8_t size;         // 1..59
    uint8_t content[WIRE_CONTENT_MAX];
};

// Memory for the queue of a class; size is a power of two, at least 256.
struct link_memory {
    uint8_t *at;
    size_t size;
};

// Initializes a link with the memories, one for each class, which it uses from then on. SETTINGS are valid.
void link_init(struct link *link, const struct link_settings *settings, const struct link_memory *memories);

// ------------------------------------------------------------------------------------------------ commands

// Queues one encoded command of KIND, LINK_CONTROL or LINK_BULK, at NOW. Order is kept within a class. It
// is not sent before min_clock (0: at once) is certainly past, some two milliseconds later.
enum link_status link_send(struct link *link, enum link_class kind, const uint8_t *content, size_t size,
                           uint64_t min_clock, uint64_t req_clock, uint64_t now);

// Queues the motion commands of a batch (batch.h), all or none.
enum link_status link_send_batch(struct link *link, const uint8_t *batch, size_t size);

// Drops everything queued and not yet sent, and sends CONTENT next, before everything else on the bus.
enum link_status link_send_urgent(struct link *link, const uint8_t *content, size_t size, uint64_t now);

// Returns the number of commands that are queued or not yet acknowledged.
uint64_t link_pending(const struct link *link);

// Returns LINK_INVALID below LINK_WINDOW_MIN. Blocks in flight are not affected.
enum link_status link_set_receive_window(struct link *link, uint64_t size);

// Sets the node's clock: it reads AT_TICKS at AT_NS and runs at FREQ_HZ (> 0, finite; else
// LINK_INVALID). Until it is set, commands with a min_clock wait.
enum link_status link_set_clock(struct link *link, double freq_hz, uint64_t at_ns, uint64_t at_ticks);

// ------------------------------------------------------------------------------------------------- driver

// Processes bytes from [*data, *data + *size) and advances both. Returns 1 with a response (call again) or 0
// when all bytes are processed. Call it with size 0 when the deadline passes: it gives up an incomplete
// block.
int link_receive(struct link *link, const uint8_t **data, size_t *size, uint64_t now,
                 struct link_response *response);

// Processes timers: repeats, and the loss of the link (once: the state becomes LINK_LOST, with a cause).
void link_handle_timer(struct link *link, uint64_t now);

// What a link would send next. Urgent offers go first, then by due_ns.
struct link_offer {
    uint64_t due_ns; // host time by which to send it; the time for a repeat is deducted
    uint8_t kind;    // enum link_class of its first command
    uint8_t urgent;  // motion whose due_ns has come, its repeat, or an urgent command
};

// Finds what the link would send now of the classes in ALLOWED (repeats and urgent motion are always
// allowed); returns 0: nothing.
int link_next_offer(const struct link *link, uint64_t now, unsigned allowed, struct link_offer *out);

// Writes that transmission (at most LINK_WIRE_MAX bytes) and returns its size; 0: nothing to send now. The
// block is filled from the class that is due first, then from the others as far as they fit.
size_t link_next_block(struct link *link, uint64_t now, unsigned allowed, uint8_t *out);

// Returns when link_handle_timer, link_receive or link_next_block with ALLOWED next has something to do.
// Later than NOW; UINT64_MAX: not without an event.
uint64_t link_deadline(const struct link *link, uint64_t now, unsigned allowed);

// Returns since when the oldest transmission has waited for its acknowledgement; UINT64_MAX: none does.
uint64_t link_unanswered_since(const struct link *link);

// Returns whether the node may owe more than acknowledgements of motion: it is being reached, or a command of
// another class is not acknowledged.
int link_awaits_answer(const struct link *link);

// Returns the host time by which to send a motion command of REQ_CLOCK, so that a loss can be repaired before
// it is due. 0: the clock is unknown.
uint64_t link_motion_due(const struct link *link, uint64_t req_clock);

// Reads the counters, including those that are computed on demand.
void link_get_stats(const struct link *link, struct link_stats *out);
// cffi: end

#define LINK_NEVER UINT64_MAX

#endif
