// SPDX-License-Identifier: Apache-2.0
// What goes wrong on a virtual bus on purpose: rules, and for every frame the verdict of all rules.
//
// A rule picks frames by id, sender and time, and of those a share or the n-th. Whether it hits depends on
// the seed, the rule's place, the sender and how many of this sender's frames the rule has picked before,
// and on nothing else: however the threads and processes of a run are scheduled, the same seed hits the same
// frames of every sender.
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
    HUB_LOSE,      // the receiver does not get the frame, the sender believes it did
    HUB_CORRUPT,   // the receiver gets it with one bit of its data changed
    HUB_DUPLICATE, // all get it, the sender believes they did not and repeats it
    HUB_ERROR,     // destroyed by an error frame: costs bus time, the sender tries again
    HUB_DELAY,     // it takes part in the arbitration only later; what its sender has behind it waits too
    HUB_BUS_OFF,   // the sender leaves the bus for a time; this frame and all it has waiting are gone
    HUB_KINDS,
};

struct hub_rule {
    uint32_t kind;
    uint32_t id, mask;  // picks frames whose id & mask is id & mask
    int32_t sender;     // -1: anyone
    int32_t receiver;   // of HUB_LOSE and HUB_CORRUPT: who is hit; -1: everyone
    double share;       // 0..1 of the frames picked
    uint64_t nth;       // not 0: instead, of each sender the n-th frame picked, counted from 1
    uint64_t from_ns;   // picks no frame before
    uint64_t until_ns;  // nor from then on
    uint64_t time_ns;   // how long a delay or bus-off lasts
    uint64_t jitter_ns; // a delay gets up to this more, evenly spread
    bool timed;         // of HUB_BUS_OFF: picks no frame; at from_ns the sender (-1: all) goes off
};

struct hub_rule_counters {
    uint64_t picked; // frames
    uint64_t hits;   // of these; of a timed rule: how often it acted
};
// cffi: end

#define HUB_EVERYONE UINT64_MAX

struct hub_faults {
    struct hub_rule rules[HUB_RULES];
    uint64_t thresholds[HUB_RULES]; // share of 2^32
    uint64_t picked[HUB_RULES][HUB_CLIENTS];
    struct hub_rule_counters counters[HUB_RULES];
    uint32_t count;
    uint32_t kinds; // bit set of those there are rules for
    uint64_t seed;
    uint64_t start_ns;
    uint64_t next_off_ns; // when a timed rule acts next, or UINT64_MAX
};

struct hub_verdict {
    uint64_t lost_to, corrupt_to; // bit set of receivers
    uint32_t corrupt_bit;         // counted from the first bit of the data
    uint32_t error_at;            // 0..2^32-1: where in the frame it is destroyed, of its length
    bool duplicate, error;
    uint64_t delay_ns;
    uint64_t off_ns; // not 0: for how long the sender goes off
};

// Takes over COUNT rules (those beyond HUB_RULES are left out) and forgets all counters.
void hub_faults_init(struct hub_faults *faults, const struct hub_rule *rules, size_t count, uint64_t seed,
                     uint64_t now_ns);

// Judges a frame by the rules whose kind is in the bit set KINDS, which counts it for them.
struct hub_verdict hub_faults_judge(struct hub_faults *faults, uint32_t kinds, int sender, uint32_t id,
                                    uint32_t length, uint64_t now_ns);

// The timed rule due up to NOW_NS, the earliest first; -1 when none is. Each is due once.
int hub_faults_due(struct hub_faults *faults, uint64_t now_ns);

#endif
