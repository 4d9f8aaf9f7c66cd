// SPDX-License-Identifier: Apache-2.0
// Fault rules of a virtual bus, and for every frame the verdict of all rules.
//
// A rule selects frames by id, sender and time, and affects a share of them, or the n-th. Which ones depends
// only on the seed, the rule's place, the sender and how many of this sender's frames the rule selected
// before: however the threads and processes of a run are scheduled, the same seed affects the same frames of
// every sender.
//
// Sans-IO; the caller owns `struct hub_faults` (about 20 KB, no pointers inside). Times are nanoseconds of
// the caller's clock, those in rules count from the call of hub_faults_init().
#ifndef VIRTUAL_HUB_FAULTS_H
#define VIRTUAL_HUB_FAULTS_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

// cffi: begin
enum { HUB_RULES = 32, HUB_CLIENTS = 64 };

enum hub_fault_kind {
    HUB_LOSE,      // the receiver does not get the frame; the sender assumes that it did
    HUB_CORRUPT,   // the receiver gets it with one bit of its data changed
    HUB_DUPLICATE, // all get it; the sender assumes that they did not, and repeats it
    HUB_ERROR,     // an error frame destroys it: takes bus time, and the sender tries again
    HUB_DELAY,     // it takes part in arbitration later, and so do the frames queued after it
    HUB_BUS_OFF,   // the sender leaves the bus for a time; this frame and all that it has waiting are lost
    HUB_KINDS,
};

struct hub_rule {
    uint32_t kind;
    uint32_t id, mask;  // selects frames whose id & mask equals id & mask
    int32_t sender;     // -1: all clients
    int32_t receiver;   // of HUB_LOSE and HUB_CORRUPT: the affected client; -1: all
    double share;       // 0..1 of the selected frames
    uint64_t nth;       // not 0: instead, the n-th selected frame of each sender, counted from 1
    uint64_t from_ns;   // selects no frame before
    uint64_t until_ns;  // nor from then on
    uint64_t time_ns;   // duration of a delay or bus-off
    uint64_t jitter_ns; // uniformly distributed addition to a delay
    bool timed;         // of HUB_BUS_OFF: selects no frame; at from_ns the sender (-1: all) leaves the bus
};

struct hub_rule_counters {
    uint64_t picked; // frames
    uint64_t hits;   // of these; of a timed rule: how often it was applied
};
// cffi: end

#define HUB_EVERYONE UINT64_MAX

struct hub_faults {
    struct hub_rule rules[HUB_RULES];
    uint64_t thresholds[HUB_RULES]; // share of 2^32
    uint64_t picked[HUB_RULES][HUB_CLIENTS];
    struct hub_rule_counters counters[HUB_RULES];
    uint32_t count;
    uint32_t kinds; // bit set of the kinds that have rules
    uint64_t seed;
    uint64_t start_ns;
    uint64_t next_off_ns; // when a timed rule is due next, or UINT64_MAX
};

struct hub_verdict {
    uint64_t lost_to, corrupt_to; // bit set of receivers
    uint32_t corrupt_bit;         // counted from the first bit of the data
    uint32_t error_at;            // 0..2^32-1: position of the error as a ratio of the frame's length
    bool duplicate, error;
    uint64_t delay_ns;
    uint64_t off_ns; // not 0: how long the sender is off the bus
};

// Sets COUNT rules (at most HUB_RULES) and clears all counters.
void hub_faults_init(struct hub_faults *faults, const struct hub_rule *rules, size_t count, uint64_t seed,
                     uint64_t now_ns);

// Returns the verdict on a frame by the rules whose kind is in the bit set KINDS, and counts it for them.
struct hub_verdict hub_faults_judge(struct hub_faults *faults, uint32_t kinds, int sender, uint32_t id,
                                    uint32_t length, uint64_t now_ns);

// Returns the next timed rule due up to NOW_NS; -1 when there is none. Each is due once.
int hub_faults_due(struct hub_faults *faults, uint64_t now_ns);

#endif
