// SPDX-License-Identifier: Apache-2.0
// sources: coordinator/motion/stats/plan_stats.c nodes/support/can_bits.c firmware/wire/vlq.c
// sources: firmware/wire/block.c
// Plan statistics: peaks, bins and their merging, frames and their bits.
#include "coordinator/motion/stats/plan_stats.h"
#include "nodes/link/core/batch.h"
#include "nodes/support/can_bits.h"
#include "tests/check.h"
#include "wire/wire.h"

enum { QUEUE_STEP = 5, FREQ = 1000000 };

static struct plan_stats stats; // 3 MB: too big for the stack of a test

static void begin(int is_serial) {
    const struct plan_node node = {
        .clock_freq = FREQ, .queue_step_id = QUEUE_STEP, .can_id = 0x100, .is_serial = is_serial};
    CHECK(plan_stats_init(&stats, &node, 1, 1.0) == 0);
}

// One queue_step of oid 3 as a batch record; returns its size.
static size_t record(uint8_t *at, uint64_t req, uint32_t interval, uint32_t count, int32_t add) {
    uint8_t payload[32];
    size_t size = 0;
    const int64_t values[] = {QUEUE_STEP, 3, interval, count, add};
    for (size_t i = 0; i < 5; i++)
        size += wire_vlq_encode(payload + size, values[i]);
    return batch_write(at, 0, req, payload, (uint8_t)size);
}

static void test_refuses_what_it_cannot_count(void) {
    struct plan_node node = {.clock_freq = 0};
    CHECK(plan_stats_init(&stats, &node, 1, 1.0) == -1);
    node.clock_freq = FREQ;
    CHECK(plan_stats_init(&stats, &node, 1, 0.0) == -1);
    CHECK(plan_stats_init(&stats, &node, PLAN_NODES + 1, 1.0) == -1);
}

static void test_peaks_and_bins_of_moves(void) {
    begin(0);
    const struct trapezoid moves[] = {
        // 3 s: to 100 mm/s within 1 s, 1 s of cruise, and back
        {.print_time = 0.5,
         .accel_s = 1,
         .cruise_s = 1,
         .decel_s = 1,
         .cruise_v = 100,
         .accel = 100,
         .ratio = {0.6, -0.8, 0, 0.05},
         .line = 7},
        {.print_time = 3.5, .cruise_s = 1, .start_v = 30, .cruise_v = 30, .ratio = {0, 0, 0, -1}, .line = 8},
    };
    plan_stats_moves(&stats, moves, 2);
    CHECK(stats.axis_speed[AXIS_X].value == 60 && stats.axis_speed[AXIS_X].line == 7);
    CHECK(stats.axis_speed[AXIS_Y].value == 80);
    CHECK(stats.axis_accel[AXIS_Y].value == 80);
    CHECK(stats.axis_speed[AXIS_Z].value == 0);
    CHECK(stats.axis_speed[AXIS_E].value == 30 && stats.axis_speed[AXIS_E].line == 8);
    CHECK(stats.axis_accel[AXIS_E].value == 5);
    CHECK(stats.path_speed.value == 100);
    CHECK(stats.flow.value == 5 && stats.flow.line == 7); // the retraction is no flow
    const float speeds[] = {50, 100, 100, 50, 0};
    CHECK(stats.bins_used == 5);
    for (int i = 0; i < 5; i++)
        CHECK(stats.bin_speed[i] == speeds[i]);
    CHECK(plan_stats_line(&stats, 2.2) == 7);
    CHECK(plan_stats_line(&stats, 4.2) == 8);
    CHECK(plan_stats_line(&stats, 1e9) == 8);
    CHECK(plan_stats_line(&stats, -1) == 0);
}

static void test_bins_merge_when_they_run_out(void) {
    begin(1);
    uint8_t batch[256];
    plan_stats_batch(&stats, 0, batch, record(batch, 10 * (uint64_t)FREQ, 1000, 7, 0));
    plan_stats_batch(&stats, 0, batch, record(batch, 11 * (uint64_t)FREQ, 1000, 5, 0));
    plan_stats_batch(&stats, 0, batch, record(batch, (uint64_t)(3.5 * PLAN_BINS) * FREQ, 1000, 3, 0));
    plan_stats_finish(&stats);
    CHECK(stats.bin_s == 4.0);
    CHECK(stats.bin_steps[0][2] == 12);
    CHECK(stats.bin_steps[0][PLAN_BINS * 7 / 8] == 3);
    uint64_t steps = 0, bits = 0;
    for (int i = 0; i < PLAN_BINS; i++) {
        steps += stats.bin_steps[0][i];
        bits += stats.bin_bits[0][i];
    }
    CHECK(steps == 15);
    CHECK(bits == stats.nodes[0].bits);
}

static void test_step_rate_is_that_of_the_shortest_interval(void) {
    begin(0);
    uint8_t batch[256];
    plan_stats_batch(&stats, 0, batch, record(batch, FREQ, 1000, 11, -50)); // the last interval is 500
    CHECK(stats.step_rate[0][3].value == 2000);
    plan_stats_batch(&stats, 0, batch, record(batch, FREQ, 400, 11, 50)); // the first is 400
    CHECK(stats.step_rate[0][3].value == 2500);
    CHECK(stats.step_rate[0][3].print_time == 1.0);
    CHECK(stats.step_rate[0][4].value == 0);
}

static void test_bits_on_a_serial_line(void) {
    begin(1);
    uint8_t batch[4096];
    size_t size = 0, content = 0;
    for (int i = 0; i < 20; i++) {
        const size_t length = record(batch + size, FREQ, 1000, 2, 0);
        content += length - BATCH_HEADER;
        size += length;
    }
    plan_stats_batch(&stats, 0, batch, size);
    plan_stats_finish(&stats);
    const size_t each = content / 20, per_block = WIRE_CONTENT_MAX / each;
    const size_t blocks = (20 + per_block - 1) / per_block;
    CHECK(stats.nodes[0].blocks == blocks);
    CHECK(stats.nodes[0].bits == PLAN_UART_BITS * (content + blocks * WIRE_BLOCK_MIN));
    CHECK(stats.bin_bits[0][1] == stats.nodes[0].bits);
}

static void test_bits_on_a_can_bus(void) {
    begin(0);
    uint8_t batch[256], block[WIRE_BLOCK_MAX];
    const size_t size = record(batch, FREQ, 1000, 2, 0), content = size - BATCH_HEADER;
    plan_stats_batch(&stats, 0, batch, size);
    plan_stats_finish(&stats);
    memcpy(block + WIRE_HEADER, batch + BATCH_HEADER, content);
    const size_t length = wire_block_finish(block, content, 0);
    CHECK(length > 8 && length <= 16); // two frames, the first of them is the sample
    const uint64_t stuffed = can_frame_bits(0x100, 8, block) - 47 - 64;
    const uint64_t plain = (47 + 64) + (47 + 8 * (length - 8)) + (47 + 40);
    CHECK(stats.nodes[0].frames == 3);
    CHECK(stats.nodes[0].bits == plain + PLAN_STUFF_SAMPLE * stuffed);
}

static void test_damaged_batches_are_counted(void) {
    begin(0);
    uint8_t batch[256];
    const size_t size = record(batch, FREQ, 1000, 2, 0);
    plan_stats_batch(&stats, 0, batch, size - 1);
    CHECK(stats.nodes[0].bad_records == 1);
    const uint8_t cut[] = {QUEUE_STEP, 3}; // a queue_step without interval
    plan_stats_batch(&stats, 0, batch, batch_write(batch, 0, FREQ, cut, sizeof(cut)));
    CHECK(stats.nodes[0].bad_records == 2);
    plan_stats_batch(&stats, 0, batch, batch_write(batch, 0, FREQ, cut, 0));
    CHECK(stats.nodes[0].bad_records == 3);
    plan_stats_batch(&stats, 1, batch, size); // no such node
    plan_stats_finish(&stats);
    CHECK(stats.nodes[0].bits == 0);
}

int main(void) {
    test_refuses_what_it_cannot_count();
    test_peaks_and_bins_of_moves();
    test_bins_merge_when_they_run_out();
    test_step_rate_is_that_of_the_shortest_interval();
    test_bits_on_a_serial_line();
    test_bits_on_a_can_bus();
    test_damaged_batches_are_counted();
    return 0;
}
