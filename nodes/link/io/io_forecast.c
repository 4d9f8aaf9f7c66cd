// SPDX-License-Identifier: Apache-2.0
// Forecasts whether queued motion will be in time. Each link describes its motion queue by a short list of
// segments: due times in the node's own ticks by position in the queue, so that nothing has to be changed
// when commands are sent or the clock is estimated again. A forecast puts the segments of all links into bins
// of host time and lets the bus serve them in the order in which they are due.
#include <string.h>

#include "nodes/link/core/batch.h"
#include "nodes/link/core/link_core.h"
#include "nodes/link/io/io_bus.h"

#define BIN_NS 10000000ULL // short compared with the look-ahead, long compared with a block
#define SEGMENT_S 0.005

enum {
    BINS = 1024,        // 10 s ahead
    ACK_BITS = 95,      // 5 data bytes and some stuff bits
    LEARN_BYTES = 4096, // of motion sent, before its measured cost is trusted
};

// Bits on the wire for a byte of motion's content, in well filled blocks: 59 bytes take 8 frames and a bit.
#define BITS_PER_CONTENT (8.3 * 118 / 59)

// --------------------------------------------------------------------------------------------------- queue

static struct io_segment *segment_at(struct io_link *node, size_t i) {
    return &node->segments[(node->segment_first + i) % IO_SEGMENTS];
}

static void drop_sent(struct io_link *node) {
    while (node->segment_count && segment_at(node, 0)->end <= node->link.queues[LINK_MOTION].head) {
        node->segment_first = (node->segment_first + 1) % IO_SEGMENTS;
        node->segment_count--;
    }
}

static void note_record(struct io_link *node, const struct batch_record *record, uint64_t start,
                        uint64_t end) {
    struct io_segment *last = node->segment_count ? segment_at(node, node->segment_count - 1) : NULL;
    uint64_t width = (uint64_t)(node->link.clock_hz * SEGMENT_S);
    int near = last && record->req_clock < last->req_clock + width;
    if (!near && node->segment_count < IO_SEGMENTS) {
        last = segment_at(node, node->segment_count++);
        *last = (struct io_segment){start, end, record->min_clock, record->req_clock, record->size};
        return;
    }
    last->end = end;
    last->content += record->size;
    last->req_clock = record->req_clock < last->req_clock ? record->req_clock : last->req_clock;
    last->min_clock = record->min_clock < last->min_clock ? record->min_clock : last->min_clock;
}

void io_note_batch(struct io_link *node, const uint8_t *batch, size_t size) {
    drop_sent(node);
    struct batch_record record;
    uint64_t start = node->link.queues[LINK_MOTION].tail - size;
    for (size_t at = 0, length; (length = batch_read(batch + at, size - at, &record)); at += length)
        note_record(node, &record, start + at, start + at + length);
}

// ------------------------------------------------------------------------------------------------ forecast

struct bin {
    double bits;
    uint64_t ready_ns; // when the first of it may be sent
    uint64_t due_ns;   // the earliest; 0: the bin is empty
};

static double bits_per_content(const struct io_bus *bus) {
    double own =
        bus->motion_content >= LEARN_BYTES ? bus->motion_bits / bus->motion_content : BITS_PER_CONTENT;
    return own + (bus->kind == IO_BYTES ? 0 : (double)ACK_BITS / WIRE_CONTENT_MAX);
}

static double bits_left(const struct io_link *node, const struct io_segment *segment, double per_content) {
    uint64_t head = node->link.queues[LINK_MOTION].head;
    uint64_t start = head > segment->start ? head : segment->start;
    double share = (double)(segment->end - start) / (double)(segment->end - segment->start);
    return share * segment->content * per_content;
}

static void fill_bins(struct io_bus *bus, uint64_t now, struct bin *bins, struct io_forecast *out) {
    double per_content = bits_per_content(bus);
    for (size_t i = 0; i < bus->link_count; i++) {
        struct io_link *node = bus->links[i];
        drop_sent(node);
        for (size_t k = 0; k < node->segment_count && node->link.clock_hz > 0; k++) {
            const struct io_segment *segment = segment_at(node, k);
            double bits = bits_left(node, segment, per_content);
            out->queued_bits += (uint64_t)bits;
            uint64_t due_ns = link_clock_to_ns(&node->link, segment->req_clock);
            uint64_t at = due_ns > now ? (due_ns - now) / BIN_NS : 0;
            if (!segment->req_clock || at >= BINS)
                continue; // no deadline, or beyond the bins
            struct bin *bin = &bins[at];
            uint64_t free_ns = link_clock_to_ns(&node->link, segment->min_clock);
            uint64_t near_ns = link_near_at(&node->link, LINK_MOTION, segment->req_clock);
            uint64_t ready_ns = free_ns > near_ns ? free_ns : near_ns;
            bin->bits += bits;
            bin->ready_ns = !bin->due_ns || ready_ns < bin->ready_ns ? ready_ns : bin->ready_ns;
            bin->due_ns = !bin->due_ns || due_ns < bin->due_ns ? due_ns : bin->due_ns;
        }
    }
}

// Serves bin by bin. START: the beginning of the current interval without idle time; demand after idle time
// must not be compared with time that passed unused.
static void serve(const struct bin *bins, uint64_t now, struct io_forecast *out) {
    uint64_t start_ns = now;
    double needed_ns = 0, all_ns = 0; // since then; since now
    for (size_t i = 0; i < BINS; i++) {
        if (!bins[i].due_ns)
            continue;
        if (bins[i].ready_ns > start_ns + (uint64_t)needed_ns) {
            start_ns = bins[i].ready_ns;
            needed_ns = 0;
        }
        double bin_ns = bins[i].bits / out->motion_bits_per_s * (double)NS_PER_S;
        needed_ns += bin_ns;
        all_ns += bin_ns;
        uint64_t end_ns = now + (i + 1) * BIN_NS; // what is in the bin is due until then, spread over it
        double stretch_ns = end_ns > start_ns + BIN_NS ? (double)(end_ns - start_ns) : (double)BIN_NS;
        double ratio = needed_ns / stretch_ns, from_now = all_ns / (double)(end_ns - now);
        ratio = ratio > from_now ? ratio : from_now;
        if (ratio > out->worst_ratio) {
            out->worst_ratio = ratio;
            out->at_ns = end_ns;
        }
        if (ratio > 1 && !out->late_ns)
            out->late_ns = bins[i].due_ns;
    }
}

void io_forecast(struct io_bus *bus, struct io_forecast *out) {
    struct bin bins[BINS];
    memset(bins, 0, sizeof bins);
    *out = (struct io_forecast){.now_ns = bus->driver.now(bus->context)};
    io_lock(bus);
    schedule_advance(&bus->schedule, out->now_ns);
    fill_bins(bus, out->now_ns, bins, out);
    out->motion_bits_per_s = bus->schedule.bitrate * schedule_left_for_motion(&bus->schedule);
    io_unlock(bus);
    if (out->motion_bits_per_s > 0)
        serve(bins, out->now_ns, out);
}
