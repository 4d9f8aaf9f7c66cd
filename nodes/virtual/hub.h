// SPDX-License-Identifier: Apache-2.0
// A virtual CAN bus: arbitration, true frame times, the same order for all clients.
//
// The core is sans-IO: it is given the time (nanoseconds of a monotonic clock) and the bytes of its clients,
// and returns bytes for them. The caller owns `struct hub` (about 1.5 MB, no pointers
// inside) and calls from one thread at a time. Nothing here allocates, blocks or fails.
//
// Clients exchange 16-byte records: `struct can_frame` of linux/can.h; only data frames with 11-bit ids are
// accepted. The head of each client's queue takes part in arbitration; the lowest id wins, equals take turns.
// The winner keeps the bus busy for its true length, then reaches all other clients at once.
//
// Nothing is lost except by `loss` or a fault (hub_faults.h): a client that does not read stops the bus
// (a real one would lose frames), and after `stuck_limit_ns` it is expelled.
#ifndef VIRTUAL_HUB_H
#define VIRTUAL_HUB_H

#include "nodes/virtual/hub_faults.h"

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

// cffi: begin
enum { HUB_RECORD = 16, HUB_INPUT = 256, HUB_OUTPUT = 1024 };

struct hub_config {
    uint32_t bitrate;        // bit/s; 0: frames take no time
    double loss;             // 0..1: share of frames that reach no client
    uint64_t seed;           // of the losses and faults: same seed, same frames
    uint64_t stuck_limit_ns; // how long one client may stop the bus
};

struct hub_counters {
    uint64_t frames;   // transferred, lost ones included
    uint64_t bits;     // their true length
    uint64_t lost;     // frames lost for all clients by a rule
    uint64_t busy_ns;  // time for which the bus was busy
    uint64_t rejected; // records that are not frames of this bus
    uint64_t expelled; // clients that stopped the bus for too long
    uint64_t refused;  // clients beyond HUB_CLIENTS
    // By rules:
    uint64_t lost_copies; // copies lost for single receivers
    uint64_t corrupted;   // frames that a client received with a changed bit
    uint64_t duplicated;  // frames repeated although all clients had received them
    uint64_t errors;      // attempts destroyed by an error frame; `bits` and `busy_ns` include them
    uint64_t delayed;     // frames
    uint64_t bus_offs;    // times that a client left the bus
    uint64_t unsent;      // frames of clients that were off
    uint64_t unheard;     // frames times clients that were off
};

struct hub_client_counters {
    uint64_t sent;     // frames of this client that were transferred
    uint64_t received; // frames of others queued for it
    uint64_t rejected; // its records that are not frames of this bus
};
// cffi: end

#define HUB_NEVER UINT64_MAX

struct hub_frame {
    uint64_t ready_ns;
    uint8_t record[HUB_RECORD];
};

enum hub_client_state {
    HUB_FREE,
    HUB_PRESENT,
    HUB_LEAVING, // disconnected, but its frames are still to be transferred
    HUB_EXPELLED,
};

struct hub_client {
    enum hub_client_state state;
    uint32_t partial_size; // bytes of a record not yet complete
    uint8_t partial[HUB_RECORD];
    uint64_t backlog_ns; // not 0: the time at which input was full; the next input has been ready since
    uint64_t stuck_ns;   // not 0: since when this client stops the bus
    uint64_t off_ns;     // until when it is off the bus
    uint32_t attempts;   // that failed in a row
    bool repeating;      // its head was delivered, and is to be sent again
    uint32_t input_head, input_tail;   // frames; free-running, as the queues are powers of two
    uint32_t output_head, output_tail; // bytes
    struct hub_frame input[HUB_INPUT];
    uint8_t output[HUB_OUTPUT * HUB_RECORD];
    struct hub_client_counters counters;
};

struct hub {
    struct hub_config config;
    uint64_t random;
    uint64_t loss_threshold; // of 2^32
    int on_wire;             // the client whose head is being sent, or -1
    bool fails;              // the frame on the wire ends in an error frame
    bool aborted;            // its sender went off the bus
    int last_winner;
    int places;         // clients[places] and higher were never used
    uint64_t free_ns;   // when the bus is or was free for the next frame
    uint64_t bit_carry; // part of a nanosecond by which free_ns is early, in 1/bitrate
    struct hub_counters counters;
    struct hub_faults faults;
    struct hub_client clients[HUB_CLIENTS];
};

void hub_init(struct hub *hub, const struct hub_config *config);

// Replaces the rules; there are none at first.
void hub_set_rules(struct hub *hub, const struct hub_rule *rules, size_t count, uint64_t now_ns);

// Returns the new client's number, or -1 (and counts) when all places are taken.
int hub_connect(struct hub *hub);

// The client no longer reads. What it sent, and what the caller still reads from it, is still transferred.
void hub_leave(struct hub *hub, int client, uint64_t now_ns);

// Returns whether the client was expelled, or left and none of its frames waits.
bool hub_finished(const struct hub *hub, int client);

// Frees the place of a finished client.
void hub_release(struct hub *hub, int client);

// Returns how many bytes the next hub_receive() of this client accepts.
size_t hub_room(const struct hub *hub, int client);

// Accepts bytes from a client, at most hub_room().
void hub_receive(struct hub *hub, int client, const uint8_t *data, size_t size, uint64_t now_ns);

// Runs the bus up to now_ns. A late call gives the same result as calls in time.
void hub_run(struct hub *hub, uint64_t now_ns);

// Returns when hub_run() is to be called next if nothing is received or taken before: possibly in the past,
// or HUB_NEVER.
uint64_t hub_deadline(const struct hub *hub);

// Sets *data to contiguous bytes that wait for a client; returns how many.
size_t hub_output(const struct hub *hub, int client, const uint8_t **data);

// Records that the client read SIZE more bytes of its output, not necessarily complete records.
void hub_taken(struct hub *hub, int client, size_t size, uint64_t now_ns);

#endif
