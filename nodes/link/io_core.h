// SPDX-License-Identifier: Apache-2.0
// The sans-IO core of one bus, as its driver sees it: bytes and time in, bytes and a deadline out. The manual
// is in io_api.h.
//
// A driver moves the bytes: the I/O thread (io_thread.h), or a simulation under virtual time. The core reads
// no clock, sleeps never and touches no descriptor. What programs ask of a bus is in io_api.h, and works on
// any bus, whatever drives it.
//
// The driver's loop, after any event:
//     io_received() with all there is, io_handle_time(), io_next() until it returns 0 or the line takes no
//     more, then sleep until io_deadline().
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
    IO_OUT_FRAMES = 25, // io_next() wants room for so many frames: a block with its longest lead-in (17) and
                        // a further block
};

// What is known of the line; all zeros are good defaults.
struct io_settings {
    uint32_t bitrate;      // bits per second; 0: unlimited or unknown, nothing is budgeted
    uint32_t queue_frames; // most that may sit in the kernel or adapter; 0: chosen from the bit rate
    double ceiling;        // share of the bit rate that is given out, 0 < ceiling <= 1; 0: the default
};

struct io_driver {
    uint64_t (*now)(void *context); // host time (CLOCK_MONOTONIC or virtual), ns
    void (*lock)(void *context);
    void (*unlock)(void *context);
    void (*kick)(void *context);   // under the lock: something was queued, it may be able to go now
    void (*notify)(void *context); // under the lock: io_take() has something; called once until all is taken
    void (*quiet)(void *context);  // under the lock: io_take() has handed over everything; may be NULL
};

// DRIVER (copied) and CONTEXT outlive the bus. NULL: no memory.
struct io_bus *io_new(enum io_kind kind, const struct io_settings *settings, const struct io_driver *driver,
                      void *context);
void io_free(struct io_bus *bus);

// Everything below wants the driver's lock held.

// Takes whole or cut struct can_frame records (a stream), exactly one (packets), or a serial line's bytes.
void io_received(struct io_bus *bus, const uint8_t *data, size_t size, uint64_t now);

// Link timers and the notices that follow from them.
void io_handle_time(struct io_bus *bus, uint64_t now);

// Writes the next bytes for the wire, whole struct can_frame records or serial bytes, and returns their size;
// 0: nothing may go now. QUEUED: what was handed over before and has not left the kernel or adapter yet, in
// frames (a serial line: bytes); IO_QUEUED_UNKNOWN: the core estimates it. ROOM is at least IO_OUT_FRAMES
// frames.
size_t io_next(struct io_bus *bus, uint64_t now, uint64_t queued, uint8_t *out, size_t room);

// Whether the core bounds what sits in the kernel, so that it pays to read how much that is.
int io_bounds_queue(const struct io_bus *bus);

// When io_handle_time() or io_next() has something to do that it has not now; UINT64_MAX: never, by itself.
uint64_t io_deadline(const struct io_bus *bus, uint64_t now);

// The transport ended: an errno, or 0 when its other end closed it.
void io_end(struct io_bus *bus, int cause);
int io_ended(const struct io_bus *bus);

// For the counters: the line took no more and sending paused; the driver woke up.
void io_count_wait(struct io_bus *bus);
void io_count_wakeup(struct io_bus *bus);
// cffi: end

#define IO_QUEUED_UNKNOWN UINT64_MAX

#endif
