// SPDX-License-Identifier: Apache-2.0
// See plan_stats.h.
#include "coordinator/motion/stats/plan_stats.h"
#include "nodes/link/core/batch.h"
#include "nodes/support/can_bits.h"
#include "wire/wire.h"

#include <math.h>
#include <stdbool.h>

enum {
    FRAME_BYTES = 8,
    FRAME_BITS = 47, // of an empty frame without stuff bits, interframe space included
};

int plan_stats_init(struct plan_stats *stats, const struct plan_node *nodes, int count, double bin_s) {
    if (count < 0 || count > PLAN_NODES || !(bin_s > 0))
        return -1;
    memset(stats, 0, sizeof(*stats));
    stats->bin_s = bin_s;
    stats->node_count = count;
    for (int i = 0; i < count; i++) {
        if (!(nodes[i].clock_freq > 0))
            return -1;
        stats->nodes[i].clock_freq = nodes[i].clock_freq;
        stats->nodes[i].queue_step_id = nodes[i].queue_step_id;
        stats->nodes[i].can_id = nodes[i].can_id;
        stats->nodes[i].is_serial = nodes[i].is_serial;
    }
    return 0;
}

// -------------------------------------------------------------------------------------------------- bins

static void halve_sums(uint64_t *bins) {
    for (size_t i = 0; i < PLAN_BINS / 2; i++)
        bins[i] = bins[2 * i] + bins[2 * i + 1];
    memset(bins + PLAN_BINS / 2, 0, PLAN_BINS / 2 * sizeof(*bins));
}

static void halve_peaks(float *bins) {
    for (size_t i = 0; i < PLAN_BINS / 2; i++)
        bins[i] = fmaxf(bins[2 * i], bins[2 * i + 1]);
    memset(bins + PLAN_BINS / 2, 0, PLAN_BINS / 2 * sizeof(*bins));
}

static void halve(struct plan_stats *stats) {
    for (int i = 0; i < stats->node_count; i++) {
        halve_sums(stats->bin_bits[i]);
        halve_sums(stats->bin_steps[i]);
    }
    halve_peaks(stats->bin_speed);
    halve_peaks(stats->bin_flow);
    int64_t *line = stats->bin_line;
    for (size_t i = 0; i < PLAN_BINS / 2; i++)
        line[i] = line[2 * i] ? line[2 * i] : line[2 * i + 1];
    memset(line + PLAN_BINS / 2, 0, PLAN_BINS / 2 * sizeof(*line));
    stats->bins_used = (stats->bins_used + 1) / 2;
    stats->bin_s *= 2;
}

static size_t bin_at(struct plan_stats *stats, double print_time) {
    if (!(print_time > 0 && isfinite(print_time)))
        print_time = 0;
    double at;
    while ((at = print_time / stats->bin_s) >= PLAN_BINS)
        halve(stats);
    const uint32_t bin = (uint32_t)at;
    if (bin >= stats->bins_used)
        stats->bins_used = bin + 1;
    return bin;
}

// ------------------------------------------------------------------------------------------------- moves

static void note_peak(struct plan_peak *peak, double value, const struct trapezoid *m) {
    if (value > peak->value)
        *peak = (struct plan_peak){value, m->print_time, m->line};
}

static double speed_at(const struct trapezoid *m, double t) {
    const double cruise_end = m->accel_s + m->cruise_s;
    if (t < m->accel_s)
        return m->start_v + m->accel * t;
    return t <= cruise_end ? m->cruise_v : m->cruise_v - m->accel * (t - cruise_end);
}

// The greatest speed between two times of the move: speed rises to the cruise and falls behind it.
static double fastest(const struct trapezoid *m, double from, double to) {
    const double top = m->accel_s;
    if (to < top)
        return speed_at(m, to);
    return from <= top + m->cruise_s ? m->cruise_v : speed_at(m, from);
}

static void fill_bins(struct plan_stats *stats, const struct trapezoid *m, double speed, double flow) {
    const double end = m->print_time + m->accel_s + m->cruise_s + m->decel_s;
    const size_t last = bin_at(stats, end); // first: it may make bins longer
    for (size_t bin = bin_at(stats, m->print_time); bin <= last; bin++) {
        const double begin = (double)bin * stats->bin_s;
        const double from = fmax(begin, m->print_time), to = fmin(begin + stats->bin_s, end);
        if (to < from)
            continue; // rounding at a border
        const double v = fastest(m, from - m->print_time, to - m->print_time);
        stats->bin_speed[bin] = fmaxf(stats->bin_speed[bin], (float)(speed * v));
        stats->bin_flow[bin] = fmaxf(stats->bin_flow[bin], (float)(flow * v));
        if (!stats->bin_line[bin])
            stats->bin_line[bin] = m->line;
    }
}

void plan_stats_moves(struct plan_stats *stats, const struct trapezoid *moves, size_t count) {
    for (const struct trapezoid *m = moves; m < moves + count; m++) {
        const bool travels = m->ratio[AXIS_X] != 0 || m->ratio[AXIS_Y] != 0 || m->ratio[AXIS_Z] != 0;
        const double flow = travels ? fmax(m->ratio[AXIS_E], 0) : 0;
        for (int i = 0; i < AXES; i++) {
            note_peak(&stats->axis_speed[i], fabs(m->ratio[i]) * m->cruise_v, m);
            if (m->accel_s + m->decel_s > 0)
                note_peak(&stats->axis_accel[i], fabs(m->ratio[i]) * m->accel, m);
        }
        note_peak(&stats->path_speed, travels * m->cruise_v, m);
        note_peak(&stats->flow, flow * m->cruise_v, m);
        fill_bins(stats, m, travels, flow);
    }
}

int64_t plan_stats_line(const struct plan_stats *stats, double print_time) {
    if (!stats->bins_used || !(print_time >= 0))
        return 0;
    const double bin = print_time / stats->bin_s;
    for (size_t i = bin < stats->bins_used ? (size_t)bin + 1 : stats->bins_used; i-- > 0;)
        if (stats->bin_line[i])
            return stats->bin_line[i];
    return 0;
}

// ------------------------------------------------------------------------------------------------ frames

static uint32_t stuff_bits(const struct plan_node *node, uint32_t size, const uint8_t *data) {
    return can_frame_bits(node->can_id, size, data) - FRAME_BITS - 8 * size;
}

// Bits of the node's block on CAN, with the acknowledgement: one frame of WIRE_BLOCK_MIN bytes.
static uint64_t can_bits(struct plan_node *node) {
    const uint32_t size = (uint32_t)wire_block_finish(node->block, node->used, node->sequence++);
    uint64_t bits = FRAME_BITS + 8 * WIRE_BLOCK_MIN;
    node->frames++;
    for (uint32_t at = 0; at < size; at += FRAME_BYTES) {
        const uint32_t length = size - at < FRAME_BYTES ? size - at : FRAME_BYTES;
        bits += FRAME_BITS + 8 * length;
        node->frames++;
        if (node->frames_to_sample-- == 0) {
            node->frames_to_sample = PLAN_STUFF_SAMPLE - 1;
            bits += PLAN_STUFF_SAMPLE * (uint64_t)stuff_bits(node, length, node->block + at);
        }
    }
    return bits;
}

static void send_block(struct plan_stats *stats, int index) {
    struct plan_node *node = &stats->nodes[index];
    if (!node->used)
        return;
    const uint64_t bits =
        node->is_serial ? (uint64_t)PLAN_UART_BITS * (node->used + WIRE_BLOCK_MIN) : can_bits(node);
    stats->bin_bits[index][bin_at(stats, node->block_time)] += bits;
    node->bits += bits;
    node->blocks++;
    node->used = 0;
}

void plan_stats_finish(struct plan_stats *stats) {
    for (int i = 0; i < stats->node_count; i++)
        send_block(stats, i);
}

// ----------------------------------------------------------------------------------------------- records

// Counts the steps of a queue_step; other commands have none. Returns false for a queue_step cut short.
static bool count_steps(struct plan_stats *stats, int index, const struct batch_record *r, double time) {
    struct plan_node *node = &stats->nodes[index];
    const uint8_t *at = r->payload, *end = r->payload + r->size;
    uint32_t id, oid, interval, count, add;
    if (wire_vlq_decode(&at, end, &id))
        return false;
    if (id != node->queue_step_id)
        return true;
    if (wire_vlq_decode(&at, end, &oid) || wire_vlq_decode(&at, end, &interval) ||
        wire_vlq_decode(&at, end, &count) || wire_vlq_decode(&at, end, &add) || oid >= PLAN_OIDS || !count)
        return false;
    stats->bin_steps[index][bin_at(stats, time)] += count;
    const double last = (double)interval + (double)(int32_t)add * (double)(count - 1);
    const double least = fmin(interval, last);
    struct plan_peak *peak = &stats->step_rate[index][oid];
    if (least > 0 && node->clock_freq > peak->value * least)
        *peak = (struct plan_peak){node->clock_freq / least, time, 0};
    return true;
}

void plan_stats_batch(struct plan_stats *stats, int index, const uint8_t *batch, size_t size) {
    if (index < 0 || index >= stats->node_count)
        return;
    struct plan_node *node = &stats->nodes[index];
    struct batch_record record;
    size_t length;
    for (; (length = batch_read(batch, size, &record)) > 0; batch += length, size -= length) {
        const double time = (double)record.req_clock / node->clock_freq;
        if (!record.size || record.size > WIRE_CONTENT_MAX || !count_steps(stats, index, &record, time)) {
            node->bad_records++;
            continue;
        }
        if (node->used + record.size > WIRE_CONTENT_MAX)
            send_block(stats, index);
        if (!node->used)
            node->block_time = time;
        memcpy(node->block + WIRE_HEADER + node->used, record.payload, record.size);
        node->used += record.size;
    }
    node->bad_records += size > 0;
}
