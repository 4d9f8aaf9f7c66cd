// SPDX-License-Identifier: Apache-2.0
// The sans-IO core of one bus for its driver: bytes and time in, bytes and a deadline out. The manual is in
// io_api.h.
//
// A driver transfers the bytes: the I/O thread (io_thread.h), or a simulation in virtual time. The core reads
// no clock, never sleeps and uses no descriptor. The functions for programs are in io_api.h, for any driver.
//
// The driver's loop, after any event:
//     io_received() with all received bytes, io_handle_time(), io_next() until it returns 0 or the line
//     accepts no more, then sleep until io_deadline().
#ifndef LINK_IO_CORE_H
#define LINK_IO_CORE_H

#include <stddef.h>
#include <stdint.h>

// cffi: begin
struct io_bus;

enum io_kind {
    IO_CAN_STREAM, // a stream of 16-byte struct can_frame
    IO_CAN_PACKET, // one struct can_frame per read and write
    IO_BYTES,      // a serial line: the bytes of one link
};

enum {
    IO_OUT_FRAMES = 25,     // room that io_next() needs, in frames: a block with its longest lead-in (17) and
                            // a further block
    IO_UNREAD_NS = 2000000, // how long received data may stay unread
};

// Properties of the line; zeros are the defaults.
struct io_settings {
    uint32_t bitrate;      // bits per second; 0: unlimited or unknown, nothing is budgeted
    uint32_t queue_frames; // most that may wait in the kernel or adapter; 0: by the bit rate
    double ceiling;        // share of the bit rate that may be used, 0 < ceiling <= 1; 0: the default
};

struct io_driver {
    uint64_t (*now)(void *context); // host time (CLOCK_MONOTONIC or virtual), ns
    void (*lock)(void *context);
    void (*unlock)(void *context);
    void (*kick)(void *context);   // under the lock: something was queued and can perhaps be sent now
    void (*notify)(void *context); // under the lock: io_take() has something; called once until all is taken
    void (*quiet)(void *context);  // under the lock: io_take() has returned everything; may be NULL
};

// DRIVER (copied) and CONTEXT outlive the bus. NULL: no memory.
struct io_bus *io_new(enum io_kind kind, const struct io_settings *settings, const struct io_driver *driver,
                      void *context);
void io_free(struct io_bus *bus);

// All functions below require the driver's lock.

// Processes complete or partial struct can_frame records (a stream), one record (packets), or serial bytes.
void io_received(struct io_bus *bus, const uint8_t *data, size_t size, uint64_t now);

// Processes the timers of links and the notices that result.
void io_handle_time(struct io_bus *bus, uint64_t now);

// Writes the next bytes for the wire, complete struct can_frame records or serial bytes, and returns their
// size; 0: nothing may be sent now. QUEUED: what still waits in the kernel or adapter, in frames (a serial
// line: bytes); IO_QUEUED_UNKNOWN: the core estimates it. ROOM is at least IO_OUT_FRAMES frames.
size_t io_next(struct io_bus *bus, uint64_t now, uint64_t queued, uint8_t *out, size_t room);

// Returns whether the core bounds what waits in the kernel, and so uses QUEUED.
int io_bounds_queue(const struct io_bus *bus);

// Returns when io_handle_time() or io_next() next has something to do; UINT64_MAX: not without an event.
uint64_t io_deadline(const struct io_bus *bus, uint64_t now);

// Returns whether what is received may stay unread until io_deadline(): there is more to send once the line
// has carried what waits in the kernel, within IO_UNREAD_NS, and nobody waits for an answer. Reports and
// triggers come so much later.
int io_may_stay_unread(const struct io_bus *bus, uint64_t now);

// The transport ended: an errno, or 0 when its other end closed it.
void io_end(struct io_bus *bus, int cause);
int io_ended(const struct io_bus *bus);

// Count that the line accepted no more and sending paused; that the driver woke up.
void io_count_wait(struct io_bus *bus);
void io_count_wakeup(struct io_bus *bus);
// cffi: end

#define IO_QUEUED_UNKNOWN UINT64_MAX

#endif
