// SPDX-License-Identifier: Apache-2.0
// What programs ask of a bus and its links, whatever drives it (io_core.h).
//
// The driver's lock guards everything of one bus, and nothing blocks under it. What is for Python (responses,
// raw frames, notices) waits in bounded rings; the driver tells when there is something, and io_take() hands
// it over in batches. Functions may be called from any thread when the driver's lock is one.
//
// When Python is slow: reading goes on, because the acknowledgements in the stream carry the motion, and a
// full ring drops its oldest entry and counts it. Answers may get lost on the wire too; who asked asks again.
// Notices (link lost, drained, transport closed) are flags and never dropped.
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
    uint64_t flying_bytes, flying_blocks;
    struct io_depth queues[LINK_CLASSES];
    struct io_flow flows[LINK_CLASSES], received; // received.blocks: see link
};

// The counters, without waiting for anybody; never older than what io_take() has handed over.
enum io_status io_get_link_stats(const struct io_bus *bus, uint32_t number, struct io_link_stats *out);
void io_get_stats(const struct io_bus *bus, struct io_stats *out);

// Whether the queued motion of all links will be in time, if the bus goes on as in the last second. Looks
// ahead over FORECAST_NS; what is due later counts once it comes near.
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
