// SPDX-License-Identifier: Apache-2.0
// sources: firmware/wire/*.c nodes/link/core/*.c nodes/link/io/*.c nodes/support/can_bits.c
// The forecast of motion to the bit and the nanosecond: how commands are grouped, which bin they fall into,
// which stretch of time is the tightest. A serial line of 1 Mbit/s whose content costs 10 bits a byte: a byte
// lasts 10 µs, 1000 bytes last one bin. The node's clock ticks once a µs.
#include <math.h>
#include <string.h>

#include "nodes/link/core/batch.h"
#include "nodes/link/io/io_bus.h"
#include "tests/check.h"

#define US 1000ULL
#define MS (1000 * US)
#define START_NS (1000 * MS)
#define TICKS 5000000000ULL // of the node, at START_NS

enum { NODE = 4, BIN_MS = 10, BITRATE = 1000000, PAYLOAD = 50, WIDTH_US = 5000 };

struct scene {
    uint64_t now_ns;
    int locks;
    struct io_bus *bus;
    uint32_t number; // of its first link
};

static uint64_t now_of(void *context) {
    return ((struct scene *)context)->now_ns;
}

static void lock(void *context) {
    CHECK_EQUAL(((struct scene *)context)->locks++, 0);
}

static void unlock(void *context) {
    CHECK_EQUAL(--((struct scene *)context)->locks, 0);
}

static void nothing(void *context) {
    (void)context;
}

static uint32_t open_link(struct scene *scene, unsigned nodeid, double clock_hz) {
    static const struct link_settings usual = {.receive_window = 192, .lost_after_ns = 5000000000};
    uint32_t number = 0;
    CHECK_EQUAL(io_open_link(scene->bus, nodeid, &usual, &number), IO_OK);
    if (clock_hz > 0)
        CHECK_EQUAL(io_set_clock(scene->bus, number, clock_hz, START_NS, TICKS), IO_OK);
    return number;
}

static void begin(struct scene *scene, enum io_kind kind, uint32_t bitrate, double clock_hz) {
    static const struct io_driver driver = {now_of, lock, unlock, nothing, nothing, NULL};
    const struct io_settings settings = {.bitrate = bitrate, .ceiling = 1.0};
    *scene = (struct scene){.now_ns = START_NS};
    scene->bus = io_new(kind, &settings, &driver, scene);
    CHECK(scene->bus);
    scene->number = open_link(scene, kind == IO_BYTES ? 0 : NODE, clock_hz);
}

static void begin_serial(struct scene *scene) {
    begin(scene, IO_BYTES, BITRATE, 1e6);
    scene->bus->motion_content = 4096;
    scene->bus->motion_bits = 40960;
}

static void end(struct scene *scene) {
    io_free(scene->bus);
}

// Queues one record; clocks in µs from START_NS, 0 for the clock 0. In memory of just its size.
static void put(struct scene *scene, uint32_t number, uint64_t min_us, uint64_t req_us, uint8_t size) {
    static const uint8_t payload[WIRE_CONTENT_MAX];
    size_t length = BATCH_HEADER + (size_t)size;
    uint8_t *batch = malloc(length);
    CHECK(batch);
    batch_write(batch, min_us ? TICKS + min_us : 0, req_us ? TICKS + req_us : 0, payload, size);
    CHECK_EQUAL(io_send_batch(scene->bus, number, batch, length), IO_OK);
    free(batch);
}

// Queues BYTES that may go from READY_MS on and are due at DUE_MS, both from START_NS.
static void queue(struct scene *scene, unsigned bytes, uint64_t ready_ms, uint64_t due_ms) {
    for (unsigned left = bytes; left; left -= PAYLOAD)
        put(scene, scene->number, ready_ms * 1000, due_ms * 1000, PAYLOAD);
}

static struct io_forecast forecast(struct scene *scene) {
    struct io_forecast out;
    memset(&out, 0xFF, sizeof out);
    io_forecast(scene->bus, &out);
    CHECK_EQUAL(out.now_ns, scene->now_ns);
    return out;
}

static void check_worst(struct scene *scene, double ratio, uint64_t at_ms, uint64_t late_ns) {
    struct io_forecast found = forecast(scene);
    if (fabs(found.worst_ratio - ratio) > 1e-9)
        fprintf(stderr, "worst ratio %.10f, expected %.10f\n", found.worst_ratio, ratio);
    CHECK(fabs(found.worst_ratio - ratio) <= 1e-9);
    CHECK_EQUAL(found.at_ns, at_ms ? START_NS + at_ms * MS : 0);
    CHECK_EQUAL(found.late_ns, late_ns);
}

// ------------------------------------------------------------------------------------------------- segments

static void commands_due_within_5_ms_are_one_segment(void) {
    struct scene scene;
    begin_serial(&scene);
    struct io_link *node = scene.bus->links[0];
    enum { LENGTH = BATCH_HEADER + 20 };
    put(&scene, scene.number, 300, 50000, 20);
    put(&scene, scene.number, 200, 50000 + WIDTH_US - 1, 20);
    put(&scene, scene.number, 400, 50000 + WIDTH_US, 20); // of the segment's beginning
    put(&scene, scene.number, 100, 48000, 20);            // goes behind, although it is due before
    CHECK_EQUAL(node->segment_count, 2);
    CHECK_EQUAL(node->segments[0].start, 0);
    CHECK_EQUAL(node->segments[0].end, 2 * LENGTH);
    CHECK_EQUAL(node->segments[0].content, 40);
    CHECK_EQUAL(node->segments[0].min_clock, TICKS + 200);
    CHECK_EQUAL(node->segments[0].req_clock, TICKS + 50000);
    CHECK_EQUAL(node->segments[1].start, 2 * LENGTH);
    CHECK_EQUAL(node->segments[1].end, 4 * LENGTH);
    CHECK_EQUAL(node->segments[1].content, 40);
    CHECK_EQUAL(node->segments[1].min_clock, TICKS + 100);
    CHECK_EQUAL(node->segments[1].req_clock, TICKS + 48000);
    end(&scene);
}

static void a_batch_is_noted_record_by_record(void) {
    struct scene scene;
    begin_serial(&scene);
    struct io_link *node = scene.bus->links[0];
    put(&scene, scene.number, 0, 1000, 7);
    static const uint8_t payload[40];
    uint8_t *batch = malloc(2 * BATCH_HEADER + 50);
    CHECK(batch);
    size_t size = batch_write(batch, 0, TICKS + 11000, payload, 10);
    size += batch_write(batch + size, 0, TICKS + 21000, payload, 40);
    CHECK_EQUAL(io_send_batch(scene.bus, scene.number, batch, size), IO_OK);
    free(batch);
    static const struct io_segment wanted[] = {
        {0, 24, 0, TICKS + 1000, 7}, {24, 51, 0, TICKS + 11000, 10}, {51, 108, 0, TICKS + 21000, 40}};
    CHECK_EQUAL(node->segment_count, 3);
    for (size_t i = 0; i < 3; i++) {
        CHECK_EQUAL(node->segments[i].start, wanted[i].start);
        CHECK_EQUAL(node->segments[i].end, wanted[i].end);
        CHECK_EQUAL(node->segments[i].req_clock, wanted[i].req_clock);
        CHECK_EQUAL(node->segments[i].content, wanted[i].content);
    }
    end(&scene);
}

// What lies too far away for a segment of its own is added to the last one, until others have been sent.
static void segments_are_bounded_and_used_again(void) {
    struct scene scene;
    begin_serial(&scene);
    struct io_link *node = scene.bus->links[0];
    for (unsigned i = 0; i < IO_SEGMENTS + 1; i++)
        put(&scene, scene.number, 0, (i + 1) * 2 * WIDTH_US, 10);
    CHECK_EQUAL(node->segment_count, IO_SEGMENTS);
    CHECK_EQUAL(node->segments[IO_SEGMENTS - 1].content, 20);
    CHECK_EQUAL(node->segments[0].content, 10);
    CHECK_EQUAL(node->segments[0].start, 0);
    node->link.queues[LINK_MOTION].head = node->segments[0].end; // the first was sent
    uint64_t last_us = (IO_SEGMENTS + 2) * 2 * WIDTH_US;
    put(&scene, scene.number, 0, last_us, 10);
    CHECK_EQUAL(node->segment_count, IO_SEGMENTS);
    CHECK_EQUAL(node->segment_first, 1);
    CHECK_EQUAL(node->segments[0].req_clock, TICKS + last_us);
    CHECK_EQUAL(node->segments[IO_SEGMENTS - 1].content, 20);
    node->link.queues[LINK_MOTION].head = node->segments[IO_SEGMENTS - 1].end;
    forecast(&scene);
    CHECK_EQUAL(node->segment_first, 0);
    CHECK_EQUAL(node->segment_count, 1);
    end(&scene);
}

static void what_was_sent_is_not_counted_any_more(void) {
    struct scene scene;
    begin_serial(&scene);
    struct io_link *node = scene.bus->links[0];
    enum { LENGTH = BATCH_HEADER + PAYLOAD };
    queue(&scene, 100, 0, 50);
    queue(&scene, 100, 0, 60);
    CHECK_EQUAL(forecast(&scene).queued_bits, 2000);
    node->link.queues[LINK_MOTION].head = LENGTH; // half of the first segment
    CHECK_EQUAL(forecast(&scene).queued_bits, 1500);
    CHECK_EQUAL(node->segment_count, 2);
    node->link.queues[LINK_MOTION].head = 2 * LENGTH;
    CHECK_EQUAL(forecast(&scene).queued_bits, 1000);
    CHECK_EQUAL(node->segment_count, 1);
    node->link.queues[LINK_MOTION].head = 3 * LENGTH;
    CHECK_EQUAL(forecast(&scene).queued_bits, 500);
    node->link.queues[LINK_MOTION].head = 4 * LENGTH;
    CHECK_EQUAL(forecast(&scene).queued_bits, 0);
    CHECK_EQUAL(node->segment_count, 0);
    end(&scene);
}

static void an_urgent_command_drops_the_queued_motion(void) {
    struct scene scene;
    begin_serial(&scene);
    queue(&scene, 10000, 0, 30);
    CHECK(forecast(&scene).worst_ratio > 1);
    CHECK_EQUAL(io_send_urgent(scene.bus, scene.number, (const uint8_t *)"!", 1), IO_OK);
    check_worst(&scene, 0, 0, 0);
    CHECK_EQUAL(forecast(&scene).queued_bits, 0);
    CHECK_EQUAL(scene.bus->links[0]->segment_count, 0);
    end(&scene);
}

// ----------------------------------------------------------------------------------------------------- bits

static void the_cost_of_content_is_learned(void) {
    struct scene scene;
    begin(&scene, IO_BYTES, BITRATE, 1e6);
    queue(&scene, 1000, 0, 50);
    scene.bus->motion_content = 4095;
    scene.bus->motion_bits = 99999;
    CHECK_EQUAL(forecast(&scene).queued_bits, 16600);
    scene.bus->motion_content = 4096;
    scene.bus->motion_bits = 3 * 4096;
    CHECK_EQUAL(forecast(&scene).queued_bits, 3000);
    scene.bus->motion_content = 8192;
    CHECK_EQUAL(forecast(&scene).queued_bits, 1500);
    end(&scene);
}

static void on_can_acknowledgements_count_too_and_all_links_share_the_bus(void) {
    struct scene scene;
    begin(&scene, IO_CAN_STREAM, BITRATE, 1e6);
    for (unsigned i = 0; i < 100; i++)
        put(&scene, scene.number, 0, 55000, WIRE_CONTENT_MAX);
    double first_bits = 100 * (8.3 * 118 + 95), second_bits = 10 * (8.3 * 118 + 95);
    CHECK_EQUAL(forecast(&scene).queued_bits, (uint64_t)first_bits);
    check_worst(&scene, first_bits / 60000, 60, START_NS + 55 * MS);
    uint32_t second = open_link(&scene, NODE + 1, 1e6);
    for (unsigned i = 0; i < 10; i++)
        put(&scene, second, 0, 52000, WIRE_CONTENT_MAX);
    CHECK_EQUAL(forecast(&scene).queued_bits, (uint64_t)first_bits + (uint64_t)second_bits);
    check_worst(&scene, (first_bits + second_bits) / 60000, 60, START_NS + 52 * MS); // the earliest
    uint32_t third = open_link(&scene, NODE + 2, 1e6);
    put(&scene, third, 0, 58000, WIRE_CONTENT_MAX);
    check_worst(&scene, (first_bits + second_bits * 1.1) / 60000, 60, START_NS + 52 * MS);
    end(&scene);
}

static void what_the_bus_can_carry(void) {
    struct scene scene;
    begin_serial(&scene);
    CHECK(forecast(&scene).motion_bits_per_s == BITRATE);
    schedule_sent(&scene.bus->schedule, LINK_CONTROL, BITRATE / 20); // half of the first 0.1 s
    CHECK(fabs(forecast(&scene).motion_bits_per_s - BITRATE / 2) < 1e-6);
    scene.now_ns += 2000 * MS;
    CHECK(forecast(&scene).motion_bits_per_s == BITRATE); // long ago
    end(&scene);

    begin(&scene, IO_BYTES, 0, 1e6); // nothing is known of the line
    queue(&scene, 1000, 0, 50);
    CHECK(forecast(&scene).motion_bits_per_s == 0);
    check_worst(&scene, 0, 0, 0);
    end(&scene);

    begin(&scene, IO_BYTES, 1, 1e6); // one bit per second
    queue(&scene, PAYLOAD, 0, 50);
    CHECK(forecast(&scene).motion_bits_per_s == 1);
    check_worst(&scene, PAYLOAD * 16.6 / 0.06, 60, START_NS + 50 * MS);
    end(&scene);
}

static void motion_of_a_node_whose_clock_is_unknown_is_not_weighed(void) {
    struct scene scene;
    begin(&scene, IO_BYTES, BITRATE, 0);
    put(&scene, scene.number, 0, 1, 50);
    CHECK_EQUAL(forecast(&scene).queued_bits, 0);
    end(&scene);
    begin(&scene, IO_BYTES, BITRATE, 1.0); // once a second
    put(&scene, scene.number, 0, 5, 50);
    check_worst(&scene, 50 * 16.6 / 5010000, 5010, 0);
    end(&scene);
}

// ----------------------------------------------------------------------------------------------------- bins

static void what_is_due_falls_into_its_bin(void) {
    static const struct {
        uint64_t due_us, end_ms; // 0: not weighed
    } cases[] = {{1, 10},           {9999, 10},    {10000, 20},   {19999, 20},  {30000, 40},
                 {10239999, 10240}, {10240000, 0}, {10250000, 0}, {20000000, 0}};
    for (size_t i = 0; i < sizeof cases / sizeof *cases; i++) {
        struct scene scene;
        begin_serial(&scene);
        put(&scene, scene.number, 0, cases[i].due_us, 50);
        uint64_t end_ms = cases[i].end_ms;
        check_worst(&scene, end_ms ? 0.5 / (double)end_ms : 0, end_ms, 0);
        CHECK_EQUAL(forecast(&scene).queued_bits, 500);
        end(&scene);
    }
}

static void what_is_overdue_is_due_in_the_first_bin(void) {
    struct scene scene;
    begin_serial(&scene);
    queue(&scene, 500, 0, 20);
    scene.now_ns += 30 * MS;
    check_worst(&scene, 0.5, 40, 0);
    queue(&scene, 550, 0, 30);
    check_worst(&scene, 1.05, 40, START_NS + 20 * MS);
    end(&scene);
}

static void commands_without_a_deadline_are_counted_but_not_weighed(void) {
    struct scene scene;
    begin_serial(&scene);
    put(&scene, scene.number, 0, 0, 50);
    CHECK_EQUAL(forecast(&scene).queued_bits, 500);
    check_worst(&scene, 0, 0, 0);
    end(&scene);
}

// ------------------------------------------------------------------------------------------------- stretches

static void demand_adds_up_from_now_on(void) {
    struct scene scene;
    begin_serial(&scene);
    queue(&scene, 500, 0, 25);
    check_worst(&scene, 5.0 / 30, 30, 0);
    queue(&scene, 2000, 0, 35);
    check_worst(&scene, 25.0 / 40, 40, 0);
    queue(&scene, 1000, 0, 105); // 35 ms in 110: the tightest remains
    check_worst(&scene, 25.0 / 40, 40, 0);
    queue(&scene, 8500, 0, 115); // 120 ms in 120 is just possible
    check_worst(&scene, 1, 120, 0);
    put(&scene, scene.number, 0, 115000, 1);
    check_worst(&scene, 120.01 / 120, 120, START_NS + 115 * MS);
    queue(&scene, 3000, 0, 125); // ... and what comes later is later still
    check_worst(&scene, 150.01 / 130, 130, START_NS + 115 * MS);
    end(&scene);
}

static void demand_after_idle_time_has_only_the_time_from_then_on(void) {
    struct scene scene;
    begin_serial(&scene);
    queue(&scene, 1000, 20, 35);
    check_worst(&scene, 10.0 / 20, 40, 0); // may not go before 20 ms, is due before 40
    queue(&scene, 1000, 30, 45);           // when the line is just done with the first
    check_worst(&scene, 20.0 / 30, 50, 0);
    queue(&scene, 1500, 60, 75); // after 20 ms without demand: 15 ms in 20
    check_worst(&scene, 15.0 / 20, 80, 0);
    queue(&scene, 2500, 70, 105); // the line is not done yet when this may go: 40 ms in 50
    check_worst(&scene, 40.0 / 50, 110, 0);
    queue(&scene, 500, 0, 115); // 45 ms in 60
    check_worst(&scene, 40.0 / 50, 110, 0);
    end(&scene);
}

// What is due late may go in idle time, and then more is to be done from now on than within the last stretch.
static void demand_that_is_due_after_idle_time_counts_from_now_on(void) {
    struct scene scene;
    begin_serial(&scene);
    queue(&scene, 900, 0, 105);
    check_worst(&scene, 9.0 / 110, 110, 0);
    queue(&scene, 500, 20, 115); // 5 ms in 100, but 14 ms in 120
    check_worst(&scene, 14.0 / 120, 120, 0);
    end(&scene);
}

// Time that has passed unused does not help, but less than a bin is not looked at.
static void a_stretch_is_a_bin_at_least(void) {
    struct scene scene;
    begin_serial(&scene);
    queue(&scene, 600, 55, 57);
    check_worst(&scene, 0.6, 60, 0);
    queue(&scene, 700, 95, 97);
    check_worst(&scene, 0.7, 100, 0);
    queue(&scene, 700, 155, 157); // as tight: the first is reported
    check_worst(&scene, 0.7, 100, 0);
    queue(&scene, 1050, 200, 205);
    check_worst(&scene, 1.05, 210, START_NS + 205 * MS);
    end(&scene);
}

// In one bin the earliest moments of all its commands count.
static void a_bin_is_ready_with_its_first_command(void) {
    struct scene scene;
    begin(&scene, IO_CAN_STREAM, BITRATE, 1e6);
    scene.bus->motion_content = 4096;
    scene.bus->motion_bits = 40960 - 4096 * 95.0 / WIRE_CONTENT_MAX; // with the acknowledgements: 10 a byte
    uint32_t links[] = {scene.number, open_link(&scene, NODE + 1, 1e6), open_link(&scene, NODE + 2, 1e6)};
    static const uint64_t ready_us[] = {40000, 30000, 45000}, due_us[] = {54000, 56000, 51000};
    static const double worst[] = {0.5 / 20, 1.0 / 30, 1.5 / 30};
    for (size_t i = 0; i < 3; i++) {
        put(&scene, links[i], ready_us[i], due_us[i], 50);
        check_worst(&scene, worst[i], 60, 0);
    }
    for (unsigned i = 0; i < 100; i++)
        put(&scene, links[1], 30000, 56000, 50);
    check_worst(&scene, 51.5 / 30, 60, START_NS + 51 * MS);
    end(&scene);
}

int main(void) {
    commands_due_within_5_ms_are_one_segment();
    a_batch_is_noted_record_by_record();
    segments_are_bounded_and_used_again();
    what_was_sent_is_not_counted_any_more();
    an_urgent_command_drops_the_queued_motion();
    the_cost_of_content_is_learned();
    on_can_acknowledgements_count_too_and_all_links_share_the_bus();
    what_the_bus_can_carry();
    motion_of_a_node_whose_clock_is_unknown_is_not_weighed();
    what_is_due_falls_into_its_bin();
    what_is_overdue_is_due_in_the_first_bin();
    commands_without_a_deadline_are_counted_but_not_weighed();
    demand_adds_up_from_now_on();
    demand_after_idle_time_has_only_the_time_from_then_on();
    demand_that_is_due_after_idle_time_counts_from_now_on();
    a_stretch_is_a_bin_at_least();
    a_bin_is_ready_with_its_first_command();
    return 0;
}
