// SPDX-License-Identifier: Apache-2.0
// sources: firmware/wire/*.c nodes/link/core/*.c nodes/support/can_bits.c
// sources: nodes/link/io/io_[cflr]*.c nodes/link/io/io_se*.c nodes/link/io/io_sc*.c
// Counters are read while they are written, and a link's place goes to another link meanwhile: whatever
// happens between two words that a reader copies, what it gets belongs together. One thread plays both.
#include <linux/can.h>
#include <stdint.h>
#include <string.h>

#include "tests/check.h"

// What to do before the word at AT is read, or VALUE is written there.
static void (*before_load)(const void *at);
static void (*before_store)(const void *at, uint64_t value);

static void note_load(const void *at) {
    if (before_load)
        before_load(at);
}

static void note_store(const void *at, uint64_t value) {
    if (before_store)
        before_store(at, value);
}

#define __atomic_load_n(at, order) (note_load(at), __atomic_load_n(at, order))
#define __atomic_store_n(at, value, order)                                                                   \
    do {                                                                                                     \
        uint64_t value_ = (value);                                                                           \
        note_store((at), value_);                                                                            \
        __atomic_store_n((at), value_, order);                                                               \
    } while (0)
#include "nodes/link/io/io_stats.c"

#define MS 1000000ULL

enum { NODE = 4, OTHER_ID = 0x3F1, FRAME = sizeof(struct can_frame) };

static const struct io_settings full_speed = {.bitrate = 1000000};
static const struct link_settings usual = {.receive_window = 192, .lost_after_ns = 1000 * MS};

static struct {
    struct io_bus *bus;
    uint64_t now_ns;
    uint32_t link, other;
    uint64_t loads; // of what is copied
    uint64_t at;    // when it happens
    uint64_t *sequence;
    uint64_t sequence_loads;
} scene;

static uint64_t now_of(void *context) {
    (void)context;
    return scene.now_ns;
}

static void nothing(void *context) {
    (void)context;
}

static void begin(void) {
    static const struct io_driver driver = {now_of, nothing, nothing, nothing, nothing, NULL};
    before_load = NULL;
    before_store = NULL;
    memset(&scene, 0, sizeof scene);
    scene.now_ns = 1050 * MS;
    scene.bus = io_new(IO_CAN_STREAM, &full_speed, &driver, NULL);
    CHECK(scene.bus);
    CHECK_EQUAL(io_open_link(scene.bus, NODE, &usual, &scene.link), IO_OK);
}

// A byte comes for the link.
static void byte_comes(void) {
    const struct can_frame frame = {.can_id = 0x101 + 2 * NODE, .can_dlc = 1, .data = {1}};
    io_received(scene.bus, (const uint8_t *)&frame, FRAME, scene.now_ns);
}

static int is_within(const void *at, const void *start, size_t size) {
    return (uintptr_t)at >= (uintptr_t)start && (uintptr_t)at < (uintptr_t)start + size;
}

// --------------------------------------------------------------------------------------------------- reading

// Publishes news once, before the word with number AT is copied.
static void publish_meanwhile(const void *at) {
    const struct io_snapshot *place = scene.bus->links[0]->snapshot;
    int is_copied = is_within(at, &scene.bus->published, sizeof scene.bus->published) ||
                    is_within(at, &place->stats, sizeof place->stats);
    if (!is_copied || scene.loads++ != scene.at)
        return;
    before_load = NULL;
    byte_comes();
    io_publish(scene.bus);
    before_load = publish_meanwhile;
}

static void what_a_reader_gets_belongs_together(void) {
    for (scene.at = 0;; scene.at++) {
        uint64_t at = scene.at, words = sizeof(struct io_stats) / 8;
        struct io_stats stats;
        begin();
        scene.at = at;
        byte_comes();
        io_publish(scene.bus);
        before_load = publish_meanwhile;
        io_get_stats(scene.bus, &stats);
        before_load = NULL;
        CHECK_EQUAL(stats.frames_received, at < words ? 2 : 1);
        CHECK_EQUAL(stats.bytes_received, stats.frames_received * FRAME);
        CHECK(stats.received_bits % stats.frames_received == 0 && stats.at_ns == scene.now_ns);
        CHECK_EQUAL(scene.loads, at < words ? 2 * words : words);
        io_free(scene.bus);
        if (at == words)
            break;
    }
    for (scene.at = 0;; scene.at++) {
        uint64_t at = scene.at, words = sizeof(struct io_link_stats) / 8;
        struct io_link_stats stats;
        begin();
        scene.at = at;
        byte_comes();
        io_publish(scene.bus);
        before_load = publish_meanwhile;
        CHECK_EQUAL(io_get_link_stats(scene.bus, scene.link, &stats), IO_OK);
        before_load = NULL;
        CHECK_EQUAL(stats.received.frames, at < words ? 2 : 1);
        CHECK_EQUAL(stats.link.bytes_received, stats.received.frames);
        CHECK_EQUAL(scene.loads, at < words ? 2 * words : words);
        io_free(scene.bus);
        if (at == words)
            break;
    }
}

// A writer is at work: what is there counts for nothing until it is done.
static void finish_writing(const void *at) {
    if (at != scene.sequence)
        return;
    CHECK(++scene.sequence_loads < 100);
    if (scene.sequence_loads == 5) { // the reader has come back twice
        scene.bus->published.frames_received = 1;
        ++*scene.sequence;
    }
}

static void a_reader_waits_for_a_writer(void) {
    struct io_stats stats;
    begin();
    byte_comes();
    io_publish(scene.bus);
    scene.sequence = &scene.bus->published_sequence;
    ++*scene.sequence;
    scene.bus->published.frames_received = 99;
    before_load = finish_writing;
    io_get_stats(scene.bus, &stats);
    before_load = NULL;
    CHECK_EQUAL(stats.frames_received, 1);
    CHECK_EQUAL(scene.sequence_loads, 6);
    io_free(scene.bus);
}

// The link is closed while its counters are copied, and its place is another's.
static void replace_link(const void *at) {
    const struct io_snapshot *place = &scene.bus->snapshots[0];
    if (!is_within(at, &place->stats, sizeof place->stats) || scene.loads++ != scene.at)
        return;
    before_load = NULL;
    io_close_link(scene.bus, scene.link);
    CHECK_EQUAL(io_open_link(scene.bus, NODE + 1, &usual, &scene.other), IO_OK);
}

static void counters_are_never_anothers(void) {
    begin();
    struct io_link_stats stats;
    scene.at = 3;
    before_load = replace_link;
    CHECK_EQUAL(io_get_link_stats(scene.bus, scene.link, &stats), IO_GONE);
    CHECK_EQUAL(scene.bus->links[0]->snapshot - scene.bus->snapshots, 0);
    CHECK_EQUAL(io_get_link_stats(scene.bus, scene.other, &stats), IO_OK);
    io_free(scene.bus);
}

static void refuse_first_place(const void *at) {
    const struct io_snapshot *place = &scene.bus->snapshots[0];
    CHECK(!is_within(at, &place->stats, sizeof place->stats));
}

static void only_the_links_own_counters_are_copied(void) {
    begin();
    struct io_link_stats stats;
    CHECK_EQUAL(io_open_link(scene.bus, NODE + 1, &usual, &scene.other), IO_OK);
    before_load = refuse_first_place;
    CHECK_EQUAL(io_get_link_stats(scene.bus, scene.other, &stats), IO_OK);
    CHECK_EQUAL(io_get_link_stats(scene.bus, scene.other + 1, &stats), IO_GONE);
    before_load = NULL;
    io_free(scene.bus);
}

// --------------------------------------------------------------------------------------------------- writing

static struct {
    const void *first, *end; // of what is written
    uint64_t values[2];      // of the sequence
    unsigned stores, sequences;
} written;

static void note_written(const void *at, uint64_t value) {
    if (at == scene.sequence) {
        CHECK(written.sequences < 2);
        CHECK(written.sequences == 0 || written.stores > 0);
        written.values[written.sequences++] = value;
    } else if (written.sequences == 1) {
        written.stores++;
        CHECK(is_within(at, written.first, (uintptr_t)written.end - (uintptr_t)written.first));
    }
}

static void check_written(uint64_t *sequence, const void *copy, size_t size, unsigned times) {
    uint64_t before = *sequence;
    memset(&written, 0, sizeof written);
    scene.sequence = sequence;
    written.first = copy;
    written.end = (const uint8_t *)copy + size;
    before_store = note_written;
    io_handle_time(scene.bus, scene.now_ns);
    before_store = NULL;
    CHECK_EQUAL(before % 2, 0);
    CHECK_EQUAL(written.sequences, 2 * times);
    CHECK_EQUAL(written.stores, times * size / 8);
    if (times)
        CHECK(written.values[0] == before + 1 && written.values[1] == before + 2);
    CHECK_EQUAL(*sequence, before + 2 * times);
}

// The sequence is odd from before the first word is written until after the last. A link of which nothing has
// changed is not copied.
static void a_writer_says_that_it_is_at_work(void) {
    begin();
    struct io_snapshot *place = scene.bus->links[0]->snapshot;
    byte_comes();
    check_written(&place->sequence, &place->stats, sizeof place->stats, 1);
    check_written(&place->sequence, &place->stats, sizeof place->stats, 0);
    check_written(&scene.bus->published_sequence, &scene.bus->published, sizeof scene.bus->published, 1);
    io_free(scene.bus);
}

// --------------------------------------------------------------------------------------------- what is in it

static void an_idle_buss_rates_are_zero_after_a_second(void) {
    struct io_stats stats;
    begin();
    byte_comes();
    io_publish(scene.bus);
    scene.now_ns += 1000 * MS;
    io_get_stats(scene.bus, &stats);
    CHECK_EQUAL(stats.recent_bits[SCHEDULE_DATA], 10 * stats.received_bits); // as it was
    scene.now_ns++;
    io_get_stats(scene.bus, &stats);
    for (int flow = 0; flow < SCHEDULE_FLOWS; flow++)
        CHECK_EQUAL(stats.recent_bits[flow], 0);
    CHECK(stats.received_bits > 0);
    io_free(scene.bus);
}

// Two blocks fly; all classes count.
static void a_links_figures_are_those_of_its_link(void) {
    struct io_link_stats stats;
    struct io_stats bus_stats;
    begin();
    struct io_link *node = scene.bus->links[0];
    node->link.first = 20;
    node->link.next = 22;
    node->link.in_flight_bytes = 77;
    node->link.in_flight_commands = 5;
    for (unsigned kind = 0; kind < LINK_CLASSES; kind++) {
        node->link.queues[kind].commands = 10 + kind;
        node->link.queues[kind].tail = node->link.queues[kind].head + 20 + kind;
        node->link.queues[kind].commands_max = 30 + kind;
        node->link.queues[kind].bytes_max = 40 + kind;
        node->flows[kind] = (struct io_flow){50 + kind, 60 + kind, 70 + kind};
        scene.bus->schedule.sent_bits[kind] = 80 + kind;
        scene.bus->schedule.slots[0][kind] = 100 + kind; // of the first tenth of a second
    }
    node->changed = 1;
    scene.bus->schedule.held_ns = 90;
    io_publish(scene.bus);
    CHECK_EQUAL(io_get_link_stats(scene.bus, scene.link, &stats), IO_OK);
    io_get_stats(scene.bus, &bus_stats);
    CHECK(stats.in_flight_blocks == 2 && stats.in_flight_bytes == 77 && stats.pending == 5 + 10 + 11 + 12);
    CHECK_EQUAL(stats.link.rto_ns, 100 * MS);
    for (unsigned kind = 0; kind < LINK_CLASSES; kind++) {
        const struct io_depth *depth = &stats.queues[kind];
        const struct io_flow *flow = &stats.flows[kind];
        CHECK(depth->commands == 10 + kind && depth->bytes == 20 + kind);
        CHECK(depth->commands_max == 30 + kind && depth->bytes_max == 40 + kind);
        CHECK(flow->frames == 50 + kind && flow->bits == 60 + kind && flow->blocks == 70 + kind);
        CHECK_EQUAL(bus_stats.sent_bits[kind], 80 + kind);
        CHECK_EQUAL(bus_stats.recent_bits[kind], 10 * (100 + kind));
    }
    CHECK(bus_stats.held_ns == 90 && bus_stats.bitrate == 1000000 && bus_stats.queue_frames == 12);
    io_free(scene.bus);
}

int main(void) {
    what_a_reader_gets_belongs_together();
    a_reader_waits_for_a_writer();
    counters_are_never_anothers();
    only_the_links_own_counters_are_copied();
    a_writer_says_that_it_is_at_work();
    an_idle_buss_rates_are_zero_after_a_second();
    a_links_figures_are_those_of_its_link();
    return 0;
}
