// SPDX-License-Identifier: Apache-2.0
// Counters that can be read at any time without making the driver wait: at the end of a round the changed
// ones are copied under a sequence counter that is odd meanwhile; readers copy until it is even and
// unchanged.
#include <string.h>

#include "nodes/link/io/io_bus.h"

// Copies word by word and atomically, so that a torn copy is a retry, not a data race. A reader of a word
// that was written after the sequence became odd sees the odd sequence; this is free on common processors.
static void copy_words(void *to, const void *from, size_t size) {
    uint64_t *out = to;
    const uint64_t *in = from;
    for (size_t i = 0; i < size / sizeof *out; i++)
        __atomic_store_n(&out[i], __atomic_load_n(&in[i], __ATOMIC_ACQUIRE), __ATOMIC_RELEASE);
}

_Static_assert(sizeof(struct io_link_stats) % sizeof(uint64_t) == 0, "copied by words");
_Static_assert(sizeof(struct io_stats) % sizeof(uint64_t) == 0, "copied by words");

static void write_snapshot(uint64_t *sequence, void *to, const void *from, size_t size) {
    uint64_t next = __atomic_load_n(sequence, __ATOMIC_RELAXED) + 1;
    __atomic_store_n(sequence, next, __ATOMIC_RELAXED);
    copy_words(to, from, size);
    __atomic_store_n(sequence, next + 1, __ATOMIC_RELEASE);
}

static void read_snapshot(const uint64_t *sequence, void *to, const void *from, size_t size) {
    for (;;) {
        uint64_t before = __atomic_load_n(sequence, __ATOMIC_ACQUIRE);
        copy_words(to, from, size);
        if (!(before & 1) && __atomic_load_n(sequence, __ATOMIC_RELAXED) == before)
            return;
    }
}

// ------------------------------------------------------------------------------------------------- writing

static struct io_depth depth_of(const struct link_queue *queue) {
    return (struct io_depth){queue->commands, link_queue_bytes(queue), queue->commands_max, queue->bytes_max};
}

static void publish_link(struct io_link *node) {
    const struct link *link = &node->link;
    struct io_link_stats stats = {
        .pending = link_pending(link),
        .in_flight_bytes = link->in_flight_bytes,
        .in_flight_blocks = link->next - link->first,
        .received = node->received,
    };
    link_get_stats(link, &stats.link);
    for (int kind = 0; kind < LINK_CLASSES; kind++) {
        stats.queues[kind] = depth_of(&link->queues[kind]);
        stats.flows[kind] = node->flows[kind];
    }
    node->changed = 0;
    write_snapshot(&node->snapshot->sequence, &node->snapshot->stats, &stats, sizeof stats);
}

static void publish_bus(struct io_bus *bus) {
    const struct schedule *schedule = &bus->schedule;
    struct io_stats *stats = &bus->stats;
    stats->bitrate = schedule->bitrate;
    stats->queue_frames = schedule->queue_frames;
    stats->received_bits = schedule->received_bits;
    stats->held_ns = schedule->held_ns;
    stats->at_ns = schedule->now_ns;
    for (int kind = 0; kind < LINK_CLASSES; kind++)
        stats->sent_bits[kind] = schedule->sent_bits[kind];
    for (unsigned flow = 0; flow < SCHEDULE_FLOWS && schedule->bitrate; flow++)
        stats->recent_bits[flow] = schedule_recent(schedule, flow);
    write_snapshot(&bus->published_sequence, &bus->published, stats, sizeof *stats);
}

void io_publish(struct io_bus *bus) {
    for (size_t i = 0; i < bus->link_count; i++)
        if (bus->links[i]->changed)
            publish_link(bus->links[i]);
    publish_bus(bus);
}

// ------------------------------------------------------------------------------------------------- reading

enum io_status io_get_link_stats(const struct io_bus *bus, uint32_t number, struct io_link_stats *out) {
    for (size_t i = 0; number && i < IO_LINKS_MAX; i++) {
        const struct io_snapshot *snapshot = &bus->snapshots[i];
        if (__atomic_load_n(&snapshot->number, __ATOMIC_ACQUIRE) != number)
            continue;
        read_snapshot(&snapshot->sequence, out, &snapshot->stats, sizeof *out);
        if (__atomic_load_n(&snapshot->number, __ATOMIC_RELAXED) == number)
            return IO_OK; // otherwise the place was given to another link meanwhile
    }
    return IO_GONE;
}

void io_get_stats(const struct io_bus *bus, struct io_stats *out) {
    read_snapshot(&bus->published_sequence, out, &bus->published, sizeof *out);
    if (bus->driver.now(bus->context) - out->at_ns > 1000000000ULL)
        memset(out->recent_bits, 0, sizeof out->recent_bits); // an idle bus publishes nothing
}
