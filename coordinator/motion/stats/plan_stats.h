// SPDX-License-Identifier: Apache-2.0
// What a plan asks of machine and buses, counted while it is made: from the planned moves, and from the
// batches exactly as they are emitted.
//
// Figures over time stand in PLAN_BINS bins of print time. When a plan lasts longer than they reach, two
// neighbours each become one and bins last twice as long: memory is bounded, however long the plan.
//
// How commands become frames: each node's commands are packed, in order, into full blocks; a block counts at
// the time its first command is due. On CAN it goes in frames of up to 8 bytes, each with its fields and
// interframe space, and the node answers every block with an acknowledgement of one 5-byte frame. Stuff bits
// are counted in the true content of one frame in PLAN_STUFF_SAMPLE, which stands for its neighbours. On a
// serial line a byte is 10 bits, and acknowledgements go the other way.
//
// The struct is the caller's; plan_stats_init begins. Nothing allocates, no function is to be called for the
// same struct from two threads at once.
#ifndef MOTION_PLAN_STATS_H
#define MOTION_PLAN_STATS_H

#include "coordinator/motion/trapezoid.h"

#include <stddef.h>
#include <stdint.h>

// cffi: begin
enum {
    PLAN_BINS = 4096,
    PLAN_NODES = 32,
    PLAN_OIDS = 256,
    PLAN_STUFF_SAMPLE = 16,
    PLAN_UART_BITS = 10, // of a byte: start, 8 data, stop
};

// The greatest value so far, when and at which program line it came first; value 0: never.
struct plan_peak {
    double value, print_time;
    int64_t line;
};

struct plan_node {
    double clock_freq; // ticks/s
    uint32_t queue_step_id;
    uint32_t can_id; // of the frames to it; only its stuff bits depend on it
    int32_t is_serial;
    // Of the block that fills; private.
    uint32_t used, sequence, frames_to_sample;
    double block_time; // s
    uint8_t block[64];
    // Totals.
    uint64_t bits, frames, blocks, bad_records;
};

struct plan_stats {
    double bin_s;
    uint32_t bins_used;
    int32_t node_count;
    struct plan_peak axis_speed[4], axis_accel[4]; // mm/s, mm/s²; X Y Z E
    struct plan_peak path_speed;                   // mm/s along X Y Z
    struct plan_peak flow;                         // mm/s of filament while X, Y or Z moves
    float bin_speed[4096], bin_flow[4096];         // the greatest in each bin
    int64_t bin_line[4096];                        // of the first move in the bin; 0: none
    struct plan_node nodes[32];
    uint64_t bin_bits[32][4096];
    uint64_t bin_steps[32][4096];        // of all its steppers, counted where their command begins
    struct plan_peak step_rate[32][256]; // by node and oid, steps/s; without a line
};

// NODES: clock_freq > 0, queue_step_id, can_id and is_serial set. Returns 0, or -1 when there are too many or
// BIN_S is not above 0.
int plan_stats_init(struct plan_stats *stats, const struct plan_node *nodes, int count, double bin_s);

void plan_stats_moves(struct plan_stats *stats, const struct trapezoid *moves, size_t count);

// Counts whole records of a node's batch (nodes/link/core/batch.h). A record that is cut short or makes no
// sense is counted as bad.
void plan_stats_batch(struct plan_stats *stats, int node, const uint8_t *batch, size_t size);

// Sends the blocks that are not full yet. Call it once, after the last batch.
void plan_stats_finish(struct plan_stats *stats);

// The program line in work at PRINT_TIME (of its bin, or of the nearest bin before with a move), 0: none.
int64_t plan_stats_line(const struct plan_stats *stats, double print_time);
// cffi: end

#endif
