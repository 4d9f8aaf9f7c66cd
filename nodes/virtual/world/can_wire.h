// SPDX-License-Identifier: Apache-2.0
// A CAN bus to the bit: controllers (ISO 11898-1) on a wire that can be cut into segments.
//
// What is modelled: start bits, arbitration by id, stuffing, acknowledgement, error frames, both error
// counters, the error-passive state with its suspended transmission, bus-off and recovery. What is
// simplified: an error frame always lasts ERROR_BITS (twelve bits of superposed flags, eight of delimiter,
// three of intermission), one without other controllers LONELY_ERROR_BITS; a frame is valid for its receivers
// when it is for its sender, at the end of EOF; there are no overload, remote or extended frames.
//
// Callbacks are made only in a consistent state of the wire: on_frame and on_sent may offer frames.
#ifndef WORLD_CAN_WIRE_H
#define WORLD_CAN_WIRE_H

#include "nodes/virtual/world/agenda.h"
#include "nodes/virtual/world/chance.h"

// cffi: begin
enum {
    CAN_CONTROLLERS_MAX = 128, // on one wire
    CAN_SEGMENTS_MAX = 4,      // into which a wire can be cut
    CAN_QUEUE_MAX = 1024,      // longest transmit queue of a controller
    CAN_ERROR_BITS = 23,       // from the wrong bit until the bus is free
    CAN_LONELY_ERROR_BITS = 17,
    CAN_SUSPEND_BITS = 8,
    CAN_RECOVERY_SEQUENCES = 128, // of 11 recessive bits each
};

enum can_state { CAN_ACTIVE, CAN_WARN, CAN_PASSIVE, CAN_OFF };

// Settings that may be changed at any time, with effect from then on.
struct can_wire_settings {
    uint32_t bitrate;  // bits per second
    double bit_errors; // probability that a bit is disturbed for all
};
struct can_controller_settings {
    double loss;         // probability that the software does not get a good frame
    double corruption;   // probability of an undetected wrong bit in a received frame
    uint64_t restart_ns; // delay from bus-off to the start of recovery; UINT64_MAX: by can_restart() only
    uint32_t queue;      // capacity in frames, including the one on the wire
    uint32_t reserved;   // of those, places for ids below 0x100 only
    uint32_t mailboxes;  // of those, how many take part in arbitration: the oldest
    int drops_when_off;  // frames that wait at bus-off, or are offered during it, are lost
};

struct can_wire_counters {
    uint64_t frames, bits;   // frames without error; bits of everything including errors, without idle time
    uint64_t errors;         // error frames of any cause
    uint64_t collisions;     // of those: senders of one id with different content
    uint64_t unacknowledged; // of those
    uint64_t disturbed;      // of those: bit errors, and frames cut off
    uint64_t yielded;        // error-passive senders that gave way to one of the same id
    uint64_t same;           // identical frames sent by several at the same time
};
struct can_controller_counters {
    uint64_t sent, received;
    uint64_t lost, corrupted;
    uint64_t refused;      // frames that found the queue full
    uint64_t dropped;      // frames in the queue when it was cleared, or offered while off
    uint64_t retries;      // attempts that ended in an error
    uint64_t passive, off; // transitions to these states
    uint64_t queue_max;
};
struct can_controller;
// Starts the recovery of a controller that is bus-off.
void can_restart(struct can_controller *controller);
// Moves the controller's end of the cable to SEGMENT (below CAN_SEGMENTS_MAX).
void can_cut(struct can_controller *controller, uint32_t segment);
// cffi: end

struct can_bits {
    uint32_t id;
    uint8_t size, data[8];
};

struct can_slot {
    struct can_bits frame;
    uint64_t number;
};

struct can_wire;
struct can_controller {
    struct can_wire *wire;
    struct can_controller_settings settings;
    struct can_controller_counters counters;
    struct chance chance;
    // Set by the owner: called for a good frame, and when a place in the queue becomes free.
    void *owner;
    void (*on_frame)(void *owner, const struct can_bits *frame);
    void (*on_sent)(void *owner);

    uint8_t powered, segment, off, recovering;
    uint16_t tec, rec;
    uint64_t joined_ns; // to its segment
    uint64_t ready_ns;  // transmission is suspended until then
    uint64_t left;      // recessive sequences until it has recovered
    uint64_t counts_from_ns;
    struct event recovery;
    uint64_t on_wire;       // number of the frame being sent; 0: none
    struct can_slot *slots; // urgent frames first, then by age
    uint32_t count;
    uint64_t last_number;
    struct can_bits babble; // sent continuously until babble_until_ns
    uint64_t babble_until_ns;
};

enum can_phase { CAN_IDLE, CAN_STARTING, CAN_BUSY };

struct can_segment {
    struct can_wire *wire;
    struct event event;
    uint8_t number, phase;
    uint8_t outcome; // of the frame on the wire, enum in can_wire.c
    uint64_t start_ns, free_ns;
    uint64_t carry, start_carry; // of the division bits / bitrate, at free_ns and at start_ns
    uint32_t free_bits;          // from the start of the frame until the bus is free
    struct can_bits frame;
};

struct can_wire {
    struct agenda *agenda;
    struct can_wire_settings settings;
    struct can_wire_counters counters;
    struct chance chance;
    struct can_segment segments[CAN_SEGMENTS_MAX];
    struct can_controller *controllers[CAN_CONTROLLERS_MAX];
    uint32_t count;
};

// Returns 0, or -1: no memory.
int can_wire_start(struct can_wire *wire, struct agenda *agenda, struct chance chance,
                   const struct can_wire_settings *settings);
// Adds CONTROLLER, whose settings, owner, callbacks and chance are set and the rest zero. Returns 0, or -1:
// no room.
int can_wire_join(struct can_wire *wire, struct can_controller *controller);
// Frees the controller's memory; the wire must not be used again.
void can_controller_free(struct can_controller *controller);

// Queues a frame. Returns 0, or -1: the queue is full (counted).
int can_offer(struct can_controller *controller, const struct can_bits *frame);
// Clears the queue; a frame on the wire is aborted, which is an error for the others.
void can_clear(struct can_controller *controller);
// A controller without power takes no part. Power on: error counters are zero and the queue is empty.
void can_power(struct can_controller *controller, int on);
// Sends FRAME continuously until UNTIL_NS.
void can_babble(struct can_controller *controller, const struct can_bits *frame, uint64_t until_ns);
enum can_state can_state_of(const struct can_controller *controller);

// ------------------------------------------------------------------------------------------ within the wire

// Returns the frame that the controller would send next, and its number; NULL: none.
const struct can_bits *can_controller_offer(const struct can_controller *controller, uint64_t now_ns,
                                            uint64_t *number);
void can_controller_sent(struct can_controller *controller);
void can_controller_received(struct can_controller *controller, const struct can_bits *frame);
// ADDED: increment of the transmit error counter.
void can_controller_send_failed(struct can_controller *controller, uint32_t added);
void can_controller_receive_failed(struct can_controller *controller);
// A frame began at START_NS on a bus free since FREE_NS; a frame ended and the bus is free from FREE_NS on.
// Both count the sequences of recessive bits that a controller needs to recover.
void can_controller_idle(struct can_controller *controller, uint64_t free_ns, uint64_t start_ns);
void can_controller_sequence(struct can_controller *controller, uint64_t free_ns);
static inline int can_controller_hears(const struct can_controller *controller) {
    return controller->powered && !controller->off;
}
// Plans the next start of a frame on the controller's segment; aborts the frame that it is sending.
void can_wire_plan(struct can_controller *controller);
void can_wire_abort(struct can_controller *controller);
uint64_t can_wire_bits_ns(const struct can_wire *wire, uint64_t bits);

#endif
