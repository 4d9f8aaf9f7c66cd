// SPDX-License-Identifier: Apache-2.0
// A CAN bus without wires: arbitration, true frame times, one order for everybody.
//
// The core is sans-IO: it is told the time (nanoseconds of a monotonic clock, never going back), takes the
// bytes of its clients and hands out bytes for them. The caller owns `struct hub` (about 1.5 MB, no pointers
// inside) and calls from one thread at a time. Nothing here allocates, blocks or fails.
//
// Clients speak 16-byte records: `struct can_frame` of linux/can.h, of which only data frames with 11-bit ids
// pass. The head of each client's queue takes part in arbitration; the lowest id wins, equals take turns. The
// winner keeps the bus busy for its true length, then reaches all other clients at once.
//
// Nothing is lost unless `loss` or a fault (hub_faults.h) says so: a client that does not read stops the bus
// (a real one would lose frames), and after `stuck_limit_ns` of that it is expelled.
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
    double loss;             // 0..1: the share of frames that reach nobody
    uint64_t seed;           // of the losses and faults: same seed, same frames
    uint64_t stuck_limit_ns; // how long one client may stop the bus
};

struct hub_counters {
    uint64_t frames;   // that went over the bus, lost ones included
    uint64_t bits;     // their true length
    uint64_t lost;     // frames taken away on purpose
    uint64_t busy_ns;  // time the bus was taken
    uint64_t rejected; // records that were no frame of this bus
    uint64_t expelled; // clients that had stopped the bus for too long
    uint64_t refused;  // clients beyond HUB_CLIENTS
    // By rules, on purpose:
    uint64_t lost_copies; // that single receivers did not get
    uint64_t corrupted;   // frames that someone got with a bit changed
    uint64_t duplicated;  // frames that went over the bus once more, although all had got them
    uint64_t errors;      // attempts destroyed by an error frame; `bits` and `busy_ns` hold what they took
    uint64_t delayed;     // frames
    uint64_t bus_offs;    // times that a client left the bus
    uint64_t unsent;      // frames of clients that were off
    uint64_t unheard;     // frames times clients that were off
};

struct hub_client_counters {
    uint64_t sent;     // frames of this client that went over the bus
    uint64_t received; // frames of others queued for it
    uint64_t rejected; // its records that were no frame of this bus
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
    HUB_LEAVING, // gone, but what it had sent still takes its turn
    HUB_EXPELLED,
};

struct hub_client {
    enum hub_client_state state;
    uint32_t partial_size; // bytes of a record not yet complete
    uint8_t partial[HUB_RECORD];
    uint64_t backlog_ns; // not 0: input was full at this time, so what comes next was ready since then
    uint64_t stuck_ns;   // not 0: since when this client stops the bus
    uint64_t off_ns;     // until when it is off the bus
    uint32_t attempts;   // that failed in a row
    bool repeating;      // its head has been delivered, and it does not know
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
    bool fails;              // what is on the wire ends in an error frame
    bool aborted;            // its sender went off the bus
    int last_winner;
    int places;         // clients[places] and all behind have never been used
    uint64_t free_ns;   // when the bus is or was free for the next frame
    uint64_t bit_carry; // part of a nanosecond by which free_ns is early, in 1/bitrate
    struct hub_counters counters;
    struct hub_faults faults;
    struct hub_client clients[HUB_CLIENTS];
};

void hub_init(struct hub *hub, const struct hub_config *config);

// From now on these rules hold, and no earlier ones; there are none at first.
void hub_set_rules(struct hub *hub, const struct hub_rule *rules, size_t count, uint64_t now_ns);

// Returns the new client's number, or -1 (and counts) when all places are taken.
int hub_connect(struct hub *hub);

// The client reads no more. What it sent, and what the caller still reads from it, takes its turn.
void hub_leave(struct hub *hub, int client, uint64_t now_ns);

// Whether the client was expelled, or left and none of its frames waits.
bool hub_finished(const struct hub *hub, int client);

// Frees the place of a finished client.
void hub_release(struct hub *hub, int client);

// How many bytes the next hub_receive() of this client can take.
size_t hub_room(const struct hub *hub, int client);

// Bytes from a client, no more than hub_room().
void hub_receive(struct hub *hub, int client, const uint8_t *data, size_t size, uint64_t now_ns);

// Lets the bus work up to now_ns. A caller who comes late finds everything done as if it had come in time.
void hub_run(struct hub *hub, uint64_t now_ns);

// When hub_run() has something to do next if nothing is received or taken before: perhaps in the past,
// perhaps HUB_NEVER.
uint64_t hub_deadline(const struct hub *hub);

// Bytes waiting for a client: returns how many are at *data in one piece.
size_t hub_output(const struct hub *hub, int client, const uint8_t **data);

// The client has taken SIZE more bytes of its output, which need not be whole records.
void hub_taken(struct hub *hub, int client, size_t size, uint64_t now_ns);

#endif
