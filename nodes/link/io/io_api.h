// SPDX-License-Identifier: Apache-2.0
// Functions of a bus and its links for programs, with any driver. This comment is the manual of nodes/link;
// the headers below describe the single functions.
//
// LAYERS. Each knows only those below it. A program includes this header, and io_thread.h for a thread.
//
//     io_thread.h   a thread that drives a bus over a file descriptor; a simulation replaces it
//     io_api.h      for programs: open links, send, take received events, read counters
//     io_core.h     for drivers: bytes and time in, bytes and a deadline out
//     schedule.h    budget and order of one bus: which link sends next, how much may wait in the kernel
//     link.h        one node's link: blocks, window, acknowledgements, repeats (states: docs/link-states.md)
//     queue.h       a bounded queue of commands, in the format of batch.h
//
// io_bus.h and link_core.h are internal headers of the core and of the link.
//
// TIME. NOW is the host's CLOCK_MONOTONIC, or a simulation's time, in ns; it never steps back. Clocks are a
// node's ticks in 64 bits, which io_set_clock relates to ns. The core reads the clock only through the
// driver's now(). io_deadline() returns when the core has something to do; a later call is late, but correct.
//
// OWNERSHIP. io_new() and io_start() create a bus, which io_free() or io_stop() destroys. Links belong to
// their bus and are identified by numbers, which are never used again: a stale number gives IO_GONE. All
// input (content, batches, settings, the driver's struct) is copied before the call returns; all output is
// written to the caller's memory. No pointer into the core is returned. The file descriptor and the driver's
// context belong to the caller and outlive the bus.
//
// LIFETIME. A bus works from io_new() until its transport ends: io_end(), which the thread calls at an end of
// file or an error. Then every call that would send returns IO_CLOSED, one IO_ENDED waits for io_take(), and
// counters, io_take() and io_close_link() continue to work until the bus is freed. A link works from
// io_open_link() until it is lost (one IO_LOST) or closed. Both are final, and its node id is free for
// another link once it is closed. When a bus is freed or stopped, no call on it may be active or follow.
//
// THREADS. One lock of the driver guards everything of one bus; different buses share nothing. With the I/O
// thread, all functions of this header may be called from any thread at any time between io_start() and
// io_stop(). Functions of io_core.h require the lock; link.h, schedule.h and queue.h have no lock and
// require that of their bus. Counters are the exception: io_get_stats() and io_get_link_stats()
// take no lock and never wait; they are never older than what io_take() has returned. Nor does io_waits().
//
// RE-ENTRY. The core calls the driver's kick, notify and quiet under the lock, from within the call that
// caused them: they must not call functions of this header for the same bus, and must not block. (The
// thread's kick writes to the non-blocking descriptor what can be sent at once.) There are no other
// callbacks: programs take events when they want.
//
// COST. Memory is allocated when a bus is created and when a link is opened (some IO_MOTION_BYTES +
// IO_CONTROL_BYTES + IO_BULK_BYTES), nowhere else. Bounds, with L links of a bus:
//
//     io_send, io_send_urgent     the command's size, L, and what the driver's kick sends at once
//     io_cork                     at its end, what the kick sends
//     io_send_batch               the batch's size (it is checked, copied, noted for the forecast), L, and
//                                 what the kick sends; when a queue is longer than ever, a copy of it
//     io_take                     the room given
//     io_received                 the bytes moved
//     io_next                     for each frame written, all L links, each of which examines no more
//                                 commands than a block holds
//     io_handle_time, io_deadline L
//     io_forecast                 L times 512 segments of queued motion, and 1024 bins of 10 ms: once per
//                                 batch, not per command
//     io_get_stats, io_get_link_stats
//                                 a copy of the struct
//
// FULL QUEUES. Nothing is accepted in part and no call waits: a command, batch or frame that has no room is
// refused with IO_FULL, and the caller tries again later. Delivery to the node is reliable and in order
// within a class (LINK_MOTION, LINK_CONTROL, LINK_BULK) from IO_OK on, unless the link is lost or
// io_send_urgent drops what is queued. Answers of nodes are checked, but not repeated: they may get lost, and
// the query is repeated.
//
// SLOW PROGRAMS. Reading continues when events are not taken, because motion depends on the acknowledgements
// in the stream; a full ring drops its oldest entry and counts it. Notices (link lost, drained, transport
// ended) are flags, and are never dropped.
//
// GARBAGE. Received bytes never cause a call to fail: invalid blocks and frames are dropped and counted
// (bytes_invalid, frames_malformed, acks_never_sent). Arguments out of range give IO_INVALID, and nothing is
// done.
#ifndef LINK_IO_API_H
#define LINK_IO_API_H

#include "nodes/link/core/link.h"
#include "nodes/link/core/schedule.h"
#include "nodes/link/io/io_core.h"

// cffi: begin
enum {
    IO_LINKS_MAX = 128,
    IO_CONTROL_BYTES = 1 << 15, // queue of control commands, per link
    IO_MOTION_BYTES = 1 << 20,  // queue of motion commands, per link
    IO_BULK_BYTES = 1 << 16,    // queue of bulk data, per link
    IO_RESPONSES_MAX = 4096,    // ring of responses, per bus
    IO_FRAMES_MAX = 1024,       // ring of received frames that belong to no link, per bus
    IO_ADMIN_MAX = 256,         // queue of frames to send that belong to no link, per bus
    IO_PATIENT_MAX = 8,         // message ids of responses that may wait, per link
    IO_ID_MAX = 5,              // bytes of such an id
};

enum io_status { IO_OK, IO_FULL, IO_INVALID, IO_GONE, IO_CLOSED, IO_TAKEN, IO_NO_MEMORY };

enum io_notice {
    IO_RESPONSE, // a link's response
    IO_FRAME,    // a CAN frame that belongs to no link
    IO_DRAINED,  // nothing is pending on a link (io_watch_drained)
    IO_SILENT,   // a node owes an acknowledgement and said nothing for LINK_SILENCE_MS, or for as long again
    IO_LOST,     // a link is lost; value: enum link_cause
    IO_ENDED,    // the transport failed or was closed by its peer; value: errno, 0 for an end of file
};

struct io_event {
    uint8_t notice; // enum io_notice
    uint8_t size;   // of content
    int32_t value;
    uint32_t link;   // number of the link, as io_open_link gave it
    uint32_t can_id; // of a frame, with its flag bits
    uint64_t sent_ns, received_ns;
    uint8_t content[WIRE_CONTENT_MAX];
};

struct io_stats {
    uint64_t frames_sent, frames_received;
    uint64_t frames_unclaimed;             // received, of no link: passed to Python or dropped
    uint64_t frames_dropped;               // of those: ring full, oldest dropped
    uint64_t frames_malformed;             // longer than 8 bytes, or incomplete
    uint64_t responses_dropped;            // ring full, oldest dropped
    uint64_t responses_max, unclaimed_max; // largest number that waited
    uint64_t admin_max;                    // largest number of admin frames that waited
    uint64_t bytes_sent, bytes_received;   // through the file descriptor
    uint64_t waits;                        // how often the kernel accepted no more and sending paused
    uint64_t wakeups;                      // number of rounds of the thread
    // Bits are the true length of each frame; they count only where the bit rate is known.
    uint64_t bitrate;
    uint64_t sent_bits[LINK_CLASSES], received_bits;
    uint64_t recent_bits[SCHEDULE_FLOWS]; // within the last second
    uint64_t queue_frames;                // most that may wait in the kernel; 0: not bounded here
    uint64_t queued_max;                  // largest number that did
    uint64_t queue_waits;                 // how often sending waited for the kernel's queue to get shorter
    uint64_t held_ns;                     // time for which the budget delayed something
    uint64_t at_ns;                       // time of these counters
};

// Moves up to ROOM events to OUT, frames first, notices after the responses received before them; returns
// their number. Fewer than ROOM: the driver notifies when there are more. What fills half of its ring, a
// flood, gets half of ROOM while anything else waits.
size_t io_take(struct io_bus *bus, struct io_event *out, size_t room);

// Returns whether io_take() has something that may wait, so that the driver has not notified yet. Takes no
// lock: a program that is awake for another reason asks, and is not woken once more.
int io_waits(const struct io_bus *bus);

// Returns the value of IO_ENDED, for a caller that got IO_CLOSED before it took that event.
int32_t io_end_cause(struct io_bus *bus);

// Adds the link of NODEID (1..255; on a serial line 0, and only one); *number identifies it.
// IO_TAKEN: there is a link with this id, or IO_LINKS_MAX links.
enum io_status io_open_link(struct io_bus *bus, unsigned nodeid, const struct link_settings *settings,
                            uint32_t *number);
void io_close_link(struct io_bus *bus, uint32_t number);

// Like the functions of link.h; IO_CLOSED when the transport has ended, IO_GONE when the link is lost or
// closed.
enum io_status io_send(struct io_bus *bus, uint32_t number, enum link_class kind, const uint8_t *content,
                       size_t size, uint64_t min_clock, uint64_t req_clock);
enum io_status io_send_batch(struct io_bus *bus, uint32_t number, const uint8_t *batch, size_t size);
enum io_status io_send_urgent(struct io_bus *bus, uint32_t number, const uint8_t *content, size_t size);
enum io_status io_set_receive_window(struct io_bus *bus, uint32_t number, uint64_t size);
enum io_status io_set_clock(struct io_bus *bus, uint32_t number, double freq_hz, uint64_t at_ns,
                            uint64_t at_ticks);

// From now on responses that begin with the message id ID may wait for others, for WAIT_NS at most: the
// driver does not notify of them alone before. 0: they may not, as at first. When TOGETHER of them wait, no
// other is expected, and the driver notifies; 0: it is not known how many come together. IO_INVALID: no id;
// IO_FULL: too many.
enum io_status io_let_wait(struct io_bus *bus, uint32_t number, const uint8_t *id, size_t size,
                           uint64_t wait_ns, uint32_t together);

// While HURRY is not 0 no response that is received waits.
enum io_status io_hurry(struct io_bus *bus, uint32_t number, int hurry);

// While CORKED is not 0, what io_send() queues is sent when the bus sends anyway, and at the latest at the
// end: commands that are queued together share blocks.
void io_cork(struct io_bus *bus, int corked);

// Sets the bit rate of the bus if io_settings did not contain it, or a wrong one: budget and forecast start
// again. 0: nothing is budgeted.
void io_set_bitrate(struct io_bus *bus, uint32_t bitrate);

// Requests one IO_DRAINED when nothing is pending (possibly at once).
enum io_status io_watch_drained(struct io_bus *bus, uint32_t number);

// Queues one frame ahead of all data, and one with an id below those of data (a stop) ahead of all frames and
// without regard to what waits in the kernel. IO_FULL, IO_INVALID (longer than 8 bytes, or a serial line),
// IO_CLOSED.
enum io_status io_send_frame(struct io_bus *bus, uint32_t can_id, const uint8_t *data, size_t size);

// Traffic of a link: sent of one class, or received. A frame that two blocks share counts for the later one.
struct io_flow {
    uint64_t frames, bits, blocks;
};

// Content of a queue, and its maximum.
struct io_depth {
    uint64_t commands, bytes, commands_max, bytes_max;
};

struct io_link_stats {
    struct link_stats link;
    uint64_t pending;
    uint64_t in_flight_bytes, in_flight_blocks;
    struct io_depth queues[LINK_CLASSES];
    struct io_flow flows[LINK_CLASSES], received; // received.blocks: see link
};

// Read the counters without waiting; never older than what io_take() has returned.
enum io_status io_get_link_stats(const struct io_bus *bus, uint32_t number, struct io_link_stats *out);
void io_get_stats(const struct io_bus *bus, struct io_stats *out);

// Forecast whether the queued motion of all links will be in time, if the bus continues as in the last
// second. It covers some 10 s; what is due later counts once it is closer.
struct io_forecast {
    uint64_t now_ns;
    double worst_ratio; // highest demand of any interval relative to what the bus can carry in it
    uint64_t at_ns;     // host time at which that interval ends; 0: no motion is queued, or nothing is known
    uint64_t late_ns;   // host time at which the first late command is due; 0: none would be late
    double motion_bits_per_s; // capacity for motion, 0: unknown
    uint64_t queued_bits;     // demand of the queued motion, acknowledgements included
};
void io_forecast(struct io_bus *bus, struct io_forecast *out);
// cffi: end

#endif
