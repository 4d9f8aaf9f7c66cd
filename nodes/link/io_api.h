// SPDX-License-Identifier: Apache-2.0
// What programs ask of a bus and its links, whatever drives it. This comment is the manual of nodes/link; the
// headers below describe one function each.
//
// LAYERS. Each knows only those below it. A program includes this header, and io_thread.h for a thread.
//
//     io_thread.h   a thread that drives a bus over a file descriptor; a simulation takes its place
//     io_api.h      for programs: open links, send, take what arrived, read counters
//     io_core.h     for drivers: bytes and time in, bytes and a deadline out
//     schedule.h    one bus's budget and order: who sends next, how much may sit in the kernel
//     link.h        one node's link: blocks, window, acknowledgements, repeats (states: docs/link-states.md)
//     queue.h       a bounded queue of commands, in the format of batch.h
//
// io_bus.h and link_core.h are the insides of the core and of the link, and for nobody else.
//
// TIME. NOW is the host's CLOCK_MONOTONIC, or a simulation's time, in ns; it never steps back. Clocks are a
// node's ticks in 64 bits, which io_set_clock relates to ns. Nothing here reads a clock but by way of the
// driver's now(). Two ways to be told of time: io_deadline() says when the core has something to do, and a
// core called later than that is late, but not wrong.
//
// OWNERSHIP. io_new() and io_start() give the caller a bus, which io_free() or io_stop() takes back. Links
// belong to their bus and are named by numbers, which are never used again, so that a stale one is harmless:
// IO_GONE. Whatever is passed in (content, batches, settings, the driver's struct) is copied before the call
// returns; whatever is passed out is written to the caller's memory. No pointer into the core leaves it. The
// file descriptor and the driver's context stay the caller's and outlive the bus.
//
// LIFETIME. A bus works from io_new() until its transport ends: io_end(), which the thread calls at an end of
// file or an error. Then every call that would send returns IO_CLOSED, one IO_ENDED waits for io_take(), and
// counters, io_take() and io_close_link() go on working until the bus is freed. A link works from
// io_open_link() until it is lost (one IO_LOST) or closed. Both are final, and its node id is free for
// another link once it is closed. When a bus is freed or stopped nobody may be inside a call on it, nor come
// later.
//
// THREADS. One lock of the driver guards everything of one bus; different buses share nothing. With the I/O
// thread, all functions of this header may be called from any thread at any time between io_start() and
// io_stop(). Functions of io_core.h want the lock held; link.h, schedule.h and queue.h have no lock at all
// and belong to whoever holds their bus's. Counters are the exception: io_get_stats() and io_get_link_stats()
// take no lock and wait for nobody; they are never older than what io_take() has handed over.
//
// RE-ENTRY. The core calls the driver's kick, notify and quiet under the lock, from within the call that
// caused them: they must not call functions of this header for the same bus, and must not block. (The
// thread's kick writes what can go at once to the descriptor, which is non-blocking.) Nothing else is called
// back: what programs want to know waits until they take it.
//
// COST. Memory is allocated when a bus is made and when a link is opened (some IO_MOTION_BYTES +
// IO_CONTROL_BYTES + IO_BULK_BYTES), nowhere else. Bounds, with L links of a bus:
//
//     io_send, io_send_urgent     the command's size, L, and what the driver's kick sends at once
//     io_send_batch               the batch's size (it is checked, copied, noted for the forecast), L, and
//                                 what the kick sends
//     io_take                     the room given
//     io_received                 the bytes moved
//     io_next                     for each frame written a look at all L links, each of which looks at no
//                                 more commands than a block holds
//     io_handle_time, io_deadline L
//     io_forecast                 L times 512 stretches of queued motion, and 1024 bins of 10 ms: once per
//                                 batch, not per command
//     io_get_stats, io_get_link_stats
//                                 a copy of the struct
//
// FULL QUEUES. Nothing is taken in part and nothing waits: a command, batch or frame that has no room is
// refused with IO_FULL, and the caller tries later. Delivery to the node is reliable and in order within a
// class (LINK_MOTION, LINK_CONTROL, LINK_BULK) from IO_OK on, unless the link is lost or io_send_urgent drops
// what is queued. Answers of nodes are checked, but not repeated: they may get lost, and who asked asks
// again.
//
// SLOW PROGRAMS. Reading goes on when nobody takes what arrived, because the acknowledgements in the stream
// carry the motion; a full ring drops its oldest entry and counts it. Notices (link lost, drained, transport
// ended) are flags, and are never dropped.
//
// GARBAGE. Bytes off a wire never fail a call: what is no sound block or frame is dropped and counted
// (bytes_invalid, frames_malformed, acks_never_sent). Arguments out of range give IO_INVALID, and nothing is
// done.
#ifndef LINK_IO_API_H
#define LINK_IO_API_H

#include "nodes/link/io_core.h"
#include "nodes/link/link.h"
#include "nodes/link/schedule.h"

// cffi: begin
enum {
    IO_LINKS_MAX = 128,
    IO_CONTROL_BYTES = 1 << 15, // queue of control commands, per link
    IO_MOTION_BYTES = 1 << 20,  // queue of motion commands, per link
    IO_BULK_BYTES = 1 << 16,    // queue of bulk data, per link
    IO_RESPONSES_MAX = 4096,    // ring of responses, per bus
    IO_FRAMES_MAX = 1024,       // ring of received frames that belong to no link, per bus
    IO_ADMIN_MAX = 256,         // queue of frames to send that belong to no link, per bus
};

enum io_status { IO_OK, IO_FULL, IO_INVALID, IO_GONE, IO_CLOSED, IO_TAKEN, IO_NO_MEMORY };

enum io_notice {
    IO_RESPONSE, // a link's response
    IO_FRAME,    // a CAN frame that belongs to no link
    IO_DRAINED,  // nothing is pending on a link, as io_watch_drained asked
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
    uint64_t frames_unclaimed;             // received, of no link: handed to Python or dropped
    uint64_t frames_dropped;               // of those: ring full, oldest dropped
    uint64_t frames_malformed;             // longer than 8 bytes, or cut short
    uint64_t responses_dropped;            // ring full, oldest dropped
    uint64_t responses_max, unclaimed_max; // most that ever waited
    uint64_t admin_max;                    // most admin frames that ever waited
    uint64_t bytes_sent, bytes_received;   // through the file descriptor
    uint64_t waits;                        // times the kernel took no more and sending paused
    uint64_t wakeups;                      // rounds of the thread
    // Bits are the true length of each frame; they count only where the bit rate is known.
    uint64_t bitrate;
    uint64_t sent_bits[LINK_CLASSES], received_bits;
    uint64_t recent_bits[SCHEDULE_FLOWS]; // within the last second
    uint64_t queue_frames;                // most that may sit in the kernel; 0: not bounded here
    uint64_t queued_max;                  // most that ever did
    uint64_t queue_waits;                 // times something waited for the kernel's queue to get shorter
    uint64_t held_ns;                     // time for which the budget held something back
    uint64_t at_ns;                       // when these were counted
};

// Moves up to ROOM events to OUT, notices after the responses that came before them; returns their number.
// Fewer than ROOM: the driver tells when there is more.
size_t io_take(struct io_bus *bus, struct io_event *out, size_t room);

// What IO_ENDED tells, for those who met IO_CLOSED before they took it.
int32_t io_end_cause(struct io_bus *bus);

// Adds the link of NODEID (1..255; on a serial line 0, and only one); *number names it from now on.
// IO_TAKEN: there is one with this id, or no place is left.
enum io_status io_open_link(struct io_bus *bus, unsigned nodeid, const struct link_settings *settings,
                            uint32_t *number);
void io_close_link(struct io_bus *bus, uint32_t number);

// As the functions of link.h; IO_CLOSED when the transport has ended, IO_GONE when the link is lost or
// closed.
enum io_status io_send(struct io_bus *bus, uint32_t number, enum link_class kind, const uint8_t *content,
                       size_t size, uint64_t min_clock, uint64_t req_clock);
enum io_status io_send_batch(struct io_bus *bus, uint32_t number, const uint8_t *batch, size_t size);
enum io_status io_send_urgent(struct io_bus *bus, uint32_t number, const uint8_t *content, size_t size);
enum io_status io_set_receive_window(struct io_bus *bus, uint32_t number, uint64_t size);
enum io_status io_set_clock(struct io_bus *bus, uint32_t number, double freq_hz, uint64_t at_ns,
                            uint64_t at_ticks);

// The bit rate of a bus that io_settings did not know, or knew wrongly: budget and forecast begin anew with
// it. 0: nothing is budgeted.
void io_set_bitrate(struct io_bus *bus, uint32_t bitrate);

// Asks for one IO_DRAINED when nothing is pending (at once, if so).
enum io_status io_watch_drained(struct io_bus *bus, uint32_t number);

// Queues one frame ahead of all data. IO_FULL, IO_INVALID (longer than 8 bytes, or a serial line), IO_CLOSED.
enum io_status io_send_frame(struct io_bus *bus, uint32_t can_id, const uint8_t *data, size_t size);

// What a link has put on the wire of one class, or has received. A frame that two blocks share counts for the
// later one.
struct io_flow {
    uint64_t frames, bits, blocks;
};

// What waits in a queue, and how much ever did.
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

// The counters, without waiting for anybody; never older than what io_take() has handed over.
enum io_status io_get_link_stats(const struct io_bus *bus, uint32_t number, struct io_link_stats *out);
void io_get_stats(const struct io_bus *bus, struct io_stats *out);

// Whether the queued motion of all links will be in time, if the bus goes on as in the last second. Looks
// ahead over some 10 s; what is due later counts once it comes near.
struct io_forecast {
    uint64_t now_ns;
    double worst_ratio; // highest demand of any stretch of time relative to what the bus can carry in it
    uint64_t at_ns;     // host time at which that stretch ends; 0: no motion is queued, or nothing is known
    uint64_t late_ns;   // host time at which the first command is due that would be late; 0: none would
    double motion_bits_per_s; // that the bus can carry, 0: unknown
    uint64_t queued_bits;     // that the queued motion needs, acknowledgements included
};
void io_forecast(struct io_bus *bus, struct io_forecast *out);
// cffi: end

#endif
