// SPDX-License-Identifier: Apache-2.0
// sources: firmware/wire/*.c nodes/link/core/*.c nodes/link/io/*.c nodes/support/can_bits.c
// The links of a bus: as many as there may be, opened and closed in any order, and what each call on one of
// them takes, refuses and shows at once.
#include <linux/can.h>
#include <string.h>

#include "nodes/link/core/batch.h"
#include "nodes/link/io/io_api.h"
#include "tests/check.h"

#define MS 1000000ULL

enum { LINKS = 128, NODE = 4, ADMIN_ID = 0x3F0, FRAME = sizeof(struct can_frame) };

static const struct io_settings unknown_speed = {0};
static const struct link_settings usual = {.receive_window = 192, .lost_after_ns = 1000 * MS};
static const uint8_t query[] = {5};

static struct {
    uint64_t now_ns;
    int locks, kicks;
} scene;

static uint64_t now_of(void *context) {
    (void)context;
    return scene.now_ns;
}

static void lock(void *context) {
    (void)context;
    CHECK_EQUAL(scene.locks++, 0);
}

static void unlock(void *context) {
    (void)context;
    CHECK_EQUAL(--scene.locks, 0);
}

static void kick(void *context) {
    (void)context;
    CHECK_EQUAL(scene.locks, 1);
    scene.kicks++;
}

static void nothing(void *context) {
    (void)context;
}

static struct io_bus *begin(enum io_kind kind, const struct io_settings *settings) {
    static const struct io_driver driver = {now_of, lock, unlock, kick, nothing, NULL};
    scene.now_ns = 1000 * MS;
    scene.locks = scene.kicks = 0;
    struct io_bus *bus = io_new(kind, settings, &driver, NULL);
    CHECK(bus);
    return bus;
}

static uint32_t open_link(struct io_bus *bus, unsigned node) {
    uint32_t number = 0;
    CHECK_EQUAL(io_open_link(bus, node, &usual, &number), IO_OK);
    return number;
}

static struct io_link_stats link_stats(struct io_bus *bus, uint32_t number) {
    struct io_link_stats stats;
    CHECK_EQUAL(io_get_link_stats(bus, number, &stats), IO_OK);
    return stats;
}

static struct io_stats bus_stats(struct io_bus *bus) {
    struct io_stats stats;
    io_handle_time(bus, scene.now_ns);
    io_get_stats(bus, &stats);
    return stats;
}

// ------------------------------------------------------------------------------------------ opening, closing

struct table {
    struct io_bus *bus;
    uint32_t numbers[256]; // by node id; 0: no link
    uint64_t heard[256];   // bytes
};

static void toggle(struct table *table, unsigned node) {
    struct io_link_stats stats;
    if (table->numbers[node]) {
        io_close_link(table->bus, table->numbers[node]);
        CHECK_EQUAL(io_get_link_stats(table->bus, table->numbers[node], &stats), IO_GONE);
        table->numbers[node] = 0;
        return;
    }
    table->numbers[node] = open_link(table->bus, node);
    table->heard[node] = 0;
    stats = link_stats(table->bus, table->numbers[node]); // nothing of one that was there before
    CHECK_EQUAL(stats.link.bytes_received, 0);
    CHECK_EQUAL(stats.link.rto_ns, 100 * MS);
}

// A byte comes from each node id: it is heard by the link of the node, if there is one.
static void check_table(struct table *table) {
    uint64_t unclaimed = bus_stats(table->bus).frames_unclaimed;
    for (unsigned node = 1; node < 256; node++) {
        const struct can_frame frame = {.can_id = 0x101 + 2 * node, .can_dlc = 1, .data = {1}};
        io_received(table->bus, (const uint8_t *)&frame, FRAME, scene.now_ns);
        unclaimed += !table->numbers[node];
        table->heard[node]++;
    }
    CHECK_EQUAL(bus_stats(table->bus).frames_unclaimed, unclaimed);
    for (unsigned node = 1; node < 256; node++)
        if (table->numbers[node])
            CHECK_EQUAL(link_stats(table->bus, table->numbers[node]).link.bytes_received, table->heard[node]);
}

static void links_come_and_go_in_any_order(void) {
    static struct table table;
    table.bus = begin(IO_CAN_STREAM, &unknown_speed);
    uint32_t number = 77;
    struct io_link_stats stats;
    for (unsigned i = 0; i < LINKS; i++)
        toggle(&table, 255 - 2 * i);
    CHECK_EQUAL(io_open_link(table.bus, 2, &usual, &number), IO_TAKEN);
    CHECK_EQUAL(number, 77);
    check_table(&table);
    uint8_t out[8 * FRAME]; // the last link may send, too: its first contact takes 8 frames
    CHECK_EQUAL(io_send(table.bus, table.numbers[1], LINK_CONTROL, query, 1, 0, 0), IO_OK);
    CHECK_EQUAL(io_next(table.bus, scene.now_ns, 0, out, sizeof out), sizeof out);
    CHECK_EQUAL(out[0], 2);
    io_close_link(table.bus, 999); // that never was
    CHECK_EQUAL(io_get_link_stats(table.bus, 999, &stats), IO_GONE);
    CHECK_EQUAL(io_get_link_stats(table.bus, 0, &stats), IO_GONE);
    const unsigned closed[] = {255, 1, 129, 131, 7}; // first, last, neighbours in the middle
    for (size_t i = 0; i < sizeof closed / sizeof *closed; i++) {
        toggle(&table, closed[i]);
        check_table(&table);
    }
    CHECK_EQUAL(io_get_link_stats(table.bus, 0, &stats), IO_GONE); // a free place is nobody's
    for (unsigned i = 0; i < sizeof closed / sizeof *closed; i++)
        toggle(&table, 100 + 2 * i);
    CHECK_EQUAL(io_open_link(table.bus, 2, &usual, &number), IO_TAKEN);
    check_table(&table);
    for (int again = 0; again < 3; again++) { // the last place
        toggle(&table, 100);
        toggle(&table, 100);
    }
    CHECK_EQUAL(table.numbers[100], LINKS + 5 + 3);
    io_free(table.bus);

    struct io_bus *bus = begin(IO_BYTES, &unknown_speed);
    number = open_link(bus, 0);
    io_close_link(bus, number);
    CHECK_EQUAL(open_link(bus, 0), number + 1);
    io_free(bus);
}

static void a_line_may_be_known_from_the_start(void) {
    static const struct io_settings one_frame = {.bitrate = 500000, .queue_frames = 1},
                                    unknown = {.queue_frames = 7};
    struct io_bus *bus = begin(IO_CAN_STREAM, &one_frame);
    CHECK(io_bounds_queue(bus));
    io_free(bus);
    bus = begin(IO_CAN_STREAM, &unknown);
    io_set_bitrate(bus, 1000000); // the other settings stay
    CHECK_EQUAL(bus_stats(bus).queue_frames, 7);
    io_free(bus);
    bus = begin(IO_BYTES, &unknown_speed);
    io_set_bitrate(bus, 1000000);
    CHECK(!io_bounds_queue(bus)); // a serial line is bounded only if asked for
    io_free(bus);
}

// ----------------------------------------------------------------------------------------------------- calls

static size_t make_batch(uint8_t *out, unsigned commands) {
    size_t size = 0;
    for (unsigned i = 0; i < commands; i++)
        size += batch_write(out + size, 0, 1000000, query, sizeof query);
    return size;
}

enum call { SEND, BATCH, URGENT, WINDOW, CLOCK, WATCH, CALLS };

static enum io_status make_call(struct io_bus *bus, uint32_t number, enum call call, int is_valid) {
    uint8_t batch[BATCH_HEADER + 1];
    size_t size = is_valid ? 1 : 0;
    switch (call) {
    case SEND:
        return io_send(bus, number, LINK_CONTROL, query, size, 0, 0);
    case BATCH:
        return io_send_batch(bus, number, batch, make_batch(batch, 1) - !size);
    case URGENT:
        return io_send_urgent(bus, number, query, size);
    case WINDOW:
        return io_set_receive_window(bus, number, 63 + size);
    case CLOCK:
        return io_set_clock(bus, number, (double)size, 0, 0);
    default:
        return io_watch_drained(bus, number);
    }
}

// What was taken is tried to be sent at once, what was refused is not.
static void each_call_says_what_became_of_it(void) {
    static const unsigned pending[CALLS] = {[SEND] = 1, [BATCH] = 1, [URGENT] = 1};
    for (int call = 0; call < CALLS; call++) {
        struct io_bus *bus = begin(IO_CAN_STREAM, &unknown_speed);
        uint32_t number = open_link(bus, NODE), other = open_link(bus, NODE + 1);
        if (call != WATCH)
            CHECK_EQUAL(make_call(bus, number, (enum call)call, 0), IO_INVALID);
        CHECK_EQUAL(make_call(bus, other + 1, (enum call)call, 1), IO_GONE);
        CHECK_EQUAL(scene.kicks, 0);
        CHECK_EQUAL(make_call(bus, number, (enum call)call, 1), IO_OK);
        CHECK_EQUAL(scene.kicks, 1);
        CHECK_EQUAL(link_stats(bus, number).pending, pending[call]);
        CHECK_EQUAL(link_stats(bus, other).pending, 0);
        io_close_link(bus, number);
        CHECK_EQUAL(make_call(bus, number, (enum call)call, 1), IO_GONE);
        io_end(bus, 0);
        CHECK_EQUAL(make_call(bus, other, (enum call)call, 1), IO_CLOSED);
        CHECK_EQUAL(make_call(bus, number, (enum call)call, 1), IO_CLOSED);
        CHECK_EQUAL(scene.kicks, 1);
        io_free(bus);
    }
}

static void send_query(struct io_bus *bus, uint32_t number, enum io_status expected, int kicks) {
    size_t size = expected == IO_INVALID ? 0 : sizeof query;
    CHECK_EQUAL(io_send(bus, number, LINK_CONTROL, query, size, 0, 0), expected);
    CHECK_EQUAL(scene.kicks, kicks);
}

static void what_is_corked_is_sent_together_at_the_end(void) {
    struct io_bus *bus = begin(IO_BYTES, &unknown_speed);
    uint32_t number = open_link(bus, 0);
    uint8_t out[1024];
    io_cork(bus, 2); // any number but 0
    send_query(bus, number, IO_OK, 0);
    send_query(bus, number, IO_OK, 0);
    CHECK_EQUAL(link_stats(bus, number).pending, 2); // it shows at once
    io_cork(bus, 0);
    CHECK_EQUAL(scene.kicks, 1);
    while (io_next(bus, scene.now_ns, 0, out, sizeof out))
        ;
    io_handle_time(bus, scene.now_ns); // so that it shows
    CHECK_EQUAL(link_stats(bus, number).in_flight_blocks, 1);
    io_cork(bus, 0); // again: there is nothing to send
    CHECK_EQUAL(scene.kicks, 1);
    send_query(bus, number, IO_OK, 2);
    io_free(bus);
}

static void a_cork_holds_back_only_what_io_send_takes(void) {
    struct io_bus *bus = begin(IO_CAN_STREAM, &unknown_speed);
    uint32_t number = open_link(bus, NODE);
    io_cork(bus, 1);
    send_query(bus, number, IO_INVALID, 0);
    io_cork(bus, 0);
    CHECK_EQUAL(scene.kicks, 0); // nothing was taken
    io_cork(bus, 1);
    send_query(bus, number, IO_OK, 0);
    for (int call = BATCH; call < CALLS; call++) {
        CHECK_EQUAL(make_call(bus, number, (enum call)call, 1), IO_OK);
        CHECK_EQUAL(scene.kicks, call - SEND);
    }
    io_end(bus, 0);
    io_cork(bus, 0);
    CHECK_EQUAL(scene.kicks, CALLS - 1 - SEND); // there is nowhere to send it to
    io_free(bus);
}

static void a_lost_link_takes_no_commands(void) {
    struct io_bus *bus = begin(IO_CAN_STREAM, &unknown_speed);
    uint32_t number = open_link(bus, NODE);
    uint8_t out[IO_OUT_FRAMES * FRAME];
    CHECK_EQUAL(make_call(bus, number, SEND, 1), IO_OK);
    for (; scene.now_ns < 3000 * MS; scene.now_ns += 100 * MS) {
        io_handle_time(bus, scene.now_ns);
        while (io_next(bus, scene.now_ns, 0, out, sizeof out) > 0)
            ;
    }
    for (int call = SEND; call <= URGENT; call++)
        CHECK_EQUAL(make_call(bus, number, (enum call)call, 1), IO_GONE);
    CHECK_EQUAL(link_stats(bus, number).pending, 1);
    io_free(bus);
}

// Bytes of each queue: 32 KiB, 1 MiB and 64 KiB.
static void queues_are_as_long_as_they_should_be(void) {
    struct io_bus *bus = begin(IO_CAN_STREAM, &unknown_speed);
    uint32_t number = open_link(bus, NODE);
    unsigned control = 0, bulk = 0, motion = 0;
    while (io_send(bus, number, LINK_CONTROL, query, 1, 0, 0) == IO_OK)
        control++;
    while (io_send(bus, number, LINK_BULK, query, 1, 0, 0) == IO_OK)
        bulk++;
    static uint8_t batch[100 * (BATCH_HEADER + 1)];
    size_t size = make_batch(batch, 100);
    while (io_send_batch(bus, number, batch, size) == IO_OK)
        motion += 100;
    CHECK_EQUAL(control, 32768 / 26); // 17 bytes, 8 of the time it was queued, and the command
    CHECK_EQUAL(bulk, 65536 / 26);
    CHECK_EQUAL(motion, 1048576 / 1800 * 100);
    CHECK_EQUAL(io_send(bus, number, LINK_CONTROL, query, 1, 0, 0), IO_FULL);
    CHECK_EQUAL(io_send_batch(bus, number, batch, size), IO_FULL);
    struct io_link_stats stats = link_stats(bus, number);
    CHECK_EQUAL(stats.queues[LINK_CONTROL].bytes, control * 26);
    CHECK_EQUAL(stats.queues[LINK_MOTION].commands_max, motion);
    CHECK_EQUAL(stats.queues[LINK_BULK].bytes_max, bulk * 26);
    io_free(bus);
}

// A plan that was dropped weighs on the forecast no more.
static void urgent_commands_empty_the_forecast(void) {
    static const struct io_settings full_speed = {.bitrate = 1000000};
    struct io_bus *bus = begin(IO_CAN_STREAM, &full_speed);
    uint32_t number = open_link(bus, NODE);
    uint8_t batch[10 * (BATCH_HEADER + 1)];
    struct io_forecast forecast;
    CHECK_EQUAL(io_set_clock(bus, number, 1e6, scene.now_ns, 0), IO_OK);
    CHECK_EQUAL(io_send_batch(bus, number, batch, make_batch(batch, 10)), IO_OK);
    io_forecast(bus, &forecast);
    CHECK(forecast.queued_bits > 0 && forecast.worst_ratio > 0);
    CHECK_EQUAL(io_send_urgent(bus, number, query, 0), IO_INVALID); // drops nothing
    io_forecast(bus, &forecast);
    CHECK(forecast.queued_bits > 0);
    CHECK_EQUAL(io_send_urgent(bus, number, query, 1), IO_OK);
    io_forecast(bus, &forecast);
    CHECK_EQUAL(forecast.queued_bits, 0);
    CHECK(!(forecast.worst_ratio > 0));
    CHECK_EQUAL(link_stats(bus, number).link.commands_dropped, 10);
    io_free(bus);
}

// A plan of commands 10 ms apart: the forecast looks at 512 stretches of it, the last of which holds the
// rest.
static void a_long_plan_is_forecast_in_512_stretches(void) {
    enum { COMMANDS = 900, STRETCHES = 512 };
    static const struct io_settings full_speed = {.bitrate = 1000000};
    struct io_bus *bus = begin(IO_CAN_STREAM, &full_speed);
    uint32_t number = open_link(bus, NODE);
    struct io_forecast forecast;
    CHECK_EQUAL(io_set_clock(bus, number, 1e9, scene.now_ns, scene.now_ns), IO_OK);
    const uint64_t start_ns = scene.now_ns + 1000 * MS;
    for (unsigned i = 0; i < COMMANDS; i++) {
        uint8_t record[BATCH_HEADER + 1];
        size_t size = batch_write(record, 0, start_ns + (10 * i + 5) * MS, query, 1);
        CHECK_EQUAL(io_send_batch(bus, number, record, size), IO_OK);
    }
    io_forecast(bus, &forecast);
    CHECK_EQUAL(forecast.at_ns, start_ns + STRETCHES * 10 * MS);
    io_free(bus);
}

// First contact: the node of NODE takes two empty blocks, the first of which has the sequence 0.
static void run_up(struct io_bus *bus, unsigned node, uint32_t number) {
    CHECK_EQUAL(io_send(bus, number, LINK_CONTROL, query, 1, 0, 0), IO_OK);
    for (unsigned expected = 1; expected <= 3; expected++) {
        uint8_t out[IO_OUT_FRAMES * FRAME];
        while (io_next(bus, scene.now_ns, 0, out, sizeof out) > 0)
            ;
        struct can_frame frame = {.can_id = 0x101 + 2 * node, .can_dlc = WIRE_BLOCK_MIN};
        CHECK_EQUAL(wire_block_finish(frame.data, 0, expected), WIRE_BLOCK_MIN);
        io_received(bus, (const uint8_t *)&frame, FRAME, scene.now_ns);
    }
    io_handle_time(bus, scene.now_ns);
    CHECK_EQUAL(link_stats(bus, number).pending, 0);
}

// Each has three full blocks, of 8 frames, to send, and all are overdue.
static void links_that_wait_alike_take_turns(void) {
    enum { COUNT = 3, BLOCKS = 3, BLOCK = 8 * FRAME };
    static const uint8_t content[WIRE_CONTENT_MAX] = {5};
    struct io_bus *bus = begin(IO_CAN_STREAM, &unknown_speed);
    uint32_t numbers[COUNT];
    for (unsigned i = 0; i < COUNT; i++) {
        numbers[i] = open_link(bus, NODE + i);
        run_up(bus, NODE + i, numbers[i]);
    }
    for (unsigned i = 0; i < COUNT * BLOCKS; i++)
        CHECK_EQUAL(io_send(bus, numbers[i % COUNT], LINK_CONTROL, content, sizeof content, 0, 0), IO_OK);
    scene.now_ns += 1000 * MS;
    for (unsigned i = 0; i < COUNT * BLOCKS; i++) {
        uint8_t out[BLOCK];
        CHECK_EQUAL(io_next(bus, scene.now_ns, 0, out, BLOCK), BLOCK);
        for (unsigned at = 0; at < BLOCK; at += FRAME)
            CHECK_EQUAL(out[at], 2 * (NODE + i % COUNT)); // the ids' last bytes
    }
    bus_stats(bus);
    struct io_link_stats stats = link_stats(bus, numbers[0]);
    CHECK(stats.flows[LINK_CONTROL].frames > 0 && stats.received.frames > 0);
    CHECK(stats.flows[LINK_CONTROL].bits == 0 && stats.received.bits == 0); // the bit rate is unknown
    io_free(bus);
}

// What was begun goes on before what is due later, though it would be the other's turn; and what is due
// earlier goes before the rest of what was begun.
static void a_block_that_was_begun_is_due_as_before(void) {
    static const struct {
        enum link_class begun, other;
        unsigned next; // whose the frame behind the begun block's first is
    } cases[] = {{LINK_CONTROL, LINK_BULK, 0}, {LINK_BULK, LINK_CONTROL, 1}};
    static const uint8_t content[WIRE_CONTENT_MAX] = {5};
    for (size_t i = 0; i < 2; i++) {
        struct io_bus *bus = begin(IO_CAN_STREAM, &unknown_speed);
        uint32_t numbers[2];
        for (unsigned k = 0; k < 2; k++) {
            numbers[k] = open_link(bus, NODE + k);
            run_up(bus, NODE + k, numbers[k]);
        }
        uint8_t out[FRAME];
        CHECK_EQUAL(io_send(bus, numbers[0], cases[i].begun, content, sizeof content, 0, 0), IO_OK);
        CHECK_EQUAL(io_next(bus, scene.now_ns, 0, out, FRAME), FRAME);
        CHECK_EQUAL(out[0], 2 * NODE);
        CHECK_EQUAL(io_send(bus, numbers[1], cases[i].other, content, sizeof content, 0, 0), IO_OK);
        for (unsigned frame = 0; frame < 15; frame++) {
            CHECK_EQUAL(io_next(bus, scene.now_ns, 0, out, FRAME), FRAME);
            unsigned owner = frame < (cases[i].next ? 8 : 7) ? cases[i].next : !cases[i].next;
            CHECK_EQUAL(out[0], 2 * (NODE + owner));
        }
        CHECK_EQUAL(io_next(bus, scene.now_ns, 0, out, FRAME), 0);
        io_free(bus);
    }
}

// ---------------------------------------------------------------------------------------------- other frames

// The queue is a ring, which wraps here.
static void frames_go_in_order_as_they_are(void) {
    struct io_bus *bus = begin(IO_CAN_PACKET, &unknown_speed);
    unsigned queued = 0, gone = 0;
    for (unsigned round = 0; round < 20; round++) {
        for (unsigned i = 0; i < 25 + (round == 0); i++, queued++) {
            const uint8_t data[8] = {(uint8_t)queued, (uint8_t)(queued >> 8), 3, 4, 5, 6, 7, 8};
            CHECK_EQUAL(io_send_frame(bus, ADMIN_ID + queued % 2, data, 2 + queued % 7), IO_OK);
        }
        uint8_t out[IO_OUT_FRAMES * FRAME];
        CHECK_EQUAL(io_next(bus, scene.now_ns, 0, out, sizeof out), sizeof out);
        for (unsigned at = 0; at < sizeof out; at += FRAME, gone++) {
            struct can_frame frame,
                wanted = {.can_id = ADMIN_ID + gone % 2, .can_dlc = (uint8_t)(2 + gone % 7)};
            const uint8_t data[8] = {(uint8_t)gone, (uint8_t)(gone >> 8), 3, 4, 5, 6, 7, 8};
            memcpy(wanted.data, data, wanted.can_dlc);
            memcpy(&frame, out + at, FRAME);
            CHECK(memcmp(&frame, &wanted, FRAME) == 0);
        }
    }
    CHECK_EQUAL(bus_stats(bus).admin_max, 26);
    for (unsigned i = 1; i < 256; i++)
        CHECK_EQUAL(io_send_frame(bus, ADMIN_ID, query, 1), IO_OK);
    CHECK_EQUAL(io_send_frame(bus, ADMIN_ID, query, 1), IO_FULL);
    CHECK_EQUAL(bus_stats(bus).admin_max, 256);
    CHECK_EQUAL(scene.kicks, 20 * 25 + 1 + 255);
    io_free(bus);
}

int main(void) {
    links_come_and_go_in_any_order();
    a_line_may_be_known_from_the_start();
    each_call_says_what_became_of_it();
    what_is_corked_is_sent_together_at_the_end();
    a_cork_holds_back_only_what_io_send_takes();
    a_lost_link_takes_no_commands();
    queues_are_as_long_as_they_should_be();
    urgent_commands_empty_the_forecast();
    a_long_plan_is_forecast_in_512_stretches();
    links_that_wait_alike_take_turns();
    a_block_that_was_begun_is_due_as_before();
    frames_go_in_order_as_they_are();
    return 0;
}
