// SPDX-License-Identifier: Apache-2.0
// sources: nodes/link/core/schedule.c
// The figures of a bus's budget to the nanosecond: where each window, share and queue begins and ends.
// 500 kbit/s: a bit lasts 2 µs, a full frame of 120 bits 240 µs, a full block of 1215 bits 2.43 ms.
#include "tests/check.h"

#include "nodes/link/core/schedule.h"

#define MS 1000000ULL
#define S (1000 * MS)
#define BIT_NS 2000
#define FRAME_NS (120 * BIT_NS)
#define BLOCK_NS (1215 * BIT_NS)

enum { BITRATE = 500000, DEFAULT_CEILING_PPM = 900000 };

static struct schedule bus(uint32_t bitrate, double ceiling, uint32_t queue_frames, int serial) {
    struct schedule schedule;
    schedule_init(&schedule, bitrate, ceiling, queue_frames, serial, S);
    return schedule;
}

static struct schedule fresh(void) {
    return bus(BITRATE, 0, 0, 0);
}

static int may(const struct schedule *schedule, enum link_class kind) {
    return (schedule_allowed(schedule) >> kind & 1) != 0;
}

static void settings_and_defaults(void) {
    CHECK_EQUAL(fresh().ceiling_ppm, DEFAULT_CEILING_PPM);
    CHECK_EQUAL(bus(BITRATE, 0.25, 0, 0).ceiling_ppm, 250000);
    CHECK_EQUAL(bus(BITRATE, 1.0, 0, 0).ceiling_ppm, 1000000);
    CHECK_EQUAL(bus(BITRATE, 1.01, 0, 0).ceiling_ppm, DEFAULT_CEILING_PPM);
    CHECK_EQUAL(bus(BITRATE, -0.5, 0, 0).ceiling_ppm, DEFAULT_CEILING_PPM);
    CHECK_EQUAL(fresh().block_ns, BLOCK_NS);
    CHECK_EQUAL(bus(0, 0, 0, 0).block_ns, 0);
    CHECK_EQUAL(bus(250000, 0, 0, 1).unit_bits, 10); // a byte with start and stop bit
    CHECK_EQUAL(fresh().unit_bits, 120);
    // 1.5 ms of frames, at least three.
    CHECK_EQUAL(bus(1000000, 0, 0, 0).queue_frames, 12);
    CHECK_EQUAL(bus(320000, 0, 0, 0).queue_frames, 4);
    CHECK_EQUAL(bus(319999, 0, 0, 0).queue_frames, 3);
    CHECK_EQUAL(bus(125000, 0, 0, 0).queue_frames, 3);
    CHECK_EQUAL(bus(1599999, 0, 0, 0).queue_frames, 19); // rounded down
    CHECK_EQUAL(bus(BITRATE, 0, 9, 0).queue_frames, 9);
    CHECK_EQUAL(bus(250000, 0, 0, 1).queue_frames, 0);
}

static void credit_grows_by_the_ceiling_up_to_a_block(void) {
    struct schedule schedule = fresh();
    schedule_advance(&schedule, S + 1 * MS);
    CHECK_EQUAL(schedule.credit_ns, 900000);
    CHECK_EQUAL(schedule.share_ns[LINK_CONTROL], 50000);
    CHECK_EQUAL(schedule.share_ns[LINK_BULK], 20000);
    CHECK_EQUAL(schedule.share_ns[LINK_MOTION], 0);
    schedule_advance(&schedule, S + 1 * MS); // time stands still: nothing comes in
    schedule_advance(&schedule, S);          // nor does it step back
    CHECK_EQUAL(schedule.now_ns, S + 1 * MS);
    CHECK_EQUAL(schedule.credit_ns, 900000);
    schedule_advance(&schedule, 2 * S + 1 * MS);
    CHECK_EQUAL(schedule.credit_ns, BLOCK_NS);
    CHECK_EQUAL(schedule.share_ns[LINK_CONTROL], BLOCK_NS);
    CHECK_EQUAL(schedule.share_ns[LINK_BULK], BLOCK_NS);
    schedule = bus(1000000, 0, 0, 0); // a block of 1.2 ms is less than a sleep may last
    schedule_advance(&schedule, 2 * S);
    CHECK_EQUAL(schedule.credit_ns, 2 * MS);
}

static void debt_has_a_bound(void) {
    struct schedule schedule = fresh();
    schedule_received(&schedule, SCHEDULE_DATA, 25000); // 50 ms
    CHECK_EQUAL(schedule.credit_ns, -50 * (int64_t)MS);
    schedule_received(&schedule, SCHEDULE_DATA, 1000);
    CHECK_EQUAL(schedule.credit_ns, -50 * (int64_t)MS);
}

// Bulk goes while there is no debt, control and motion with up to 20 ms of it, and no longer.
static void where_each_class_is_closed(void) {
    struct schedule schedule = fresh();
    CHECK(may(&schedule, LINK_BULK));
    schedule.credit_ns = -1;
    CHECK(!may(&schedule, LINK_BULK) && may(&schedule, LINK_CONTROL) && may(&schedule, LINK_MOTION));
    schedule.credit_ns = -20 * (int64_t)MS;
    CHECK_EQUAL(schedule_allowed(&schedule), 1u << LINK_MOTION | 1u << LINK_CONTROL);
    schedule.credit_ns--;
    CHECK_EQUAL(schedule_allowed(&schedule), 0);
    // A class that saved up a whole block of its own share goes nevertheless; motion has none.
    for (int kind = LINK_MOTION; kind < LINK_CLASSES; kind++)
        schedule.share_ns[kind] = BLOCK_NS - 1;
    CHECK_EQUAL(schedule_allowed(&schedule), 0);
    for (int kind = LINK_MOTION; kind < LINK_CLASSES; kind++)
        schedule.share_ns[kind] = BLOCK_NS;
    CHECK_EQUAL(schedule_allowed(&schedule), 1u << LINK_CONTROL | 1u << LINK_BULK);
}

// The moment that is promised is the first at which it is open, but for a rounding of 2 ns.
static void check_opening(struct schedule schedule, enum link_class kind, uint64_t after_ns) {
    uint64_t opens_ns = schedule_opens_at(&schedule, kind);
    CHECK(opens_ns - schedule.now_ns >= after_ns && opens_ns - schedule.now_ns <= after_ns + 1);
    struct schedule before = schedule;
    schedule_advance(&before, opens_ns - 100);
    CHECK(!may(&before, kind));
    schedule_advance(&schedule, opens_ns);
    CHECK(may(&schedule, kind));
}

static void openings_are_promised_exactly(void) {
    struct schedule schedule = fresh();
    CHECK_EQUAL(schedule_opens_at(&schedule, LINK_BULK), S); // open: now
    CHECK_EQUAL(schedule_opens_at(&schedule, LINK_CONTROL), S);
    schedule.credit_ns = -9 * (int64_t)MS;
    check_opening(schedule, LINK_BULK, 10 * MS);
    CHECK_EQUAL(schedule_opens_at(&schedule, LINK_BULK), S + 10 * MS + 1);
    CHECK_EQUAL(schedule_opens_at(&schedule, LINK_CONTROL), S);
    CHECK_EQUAL(schedule_opens_at(&schedule, LINK_MOTION), S);
    schedule.credit_ns = -38 * (int64_t)MS;
    CHECK_EQUAL(schedule_opens_at(&schedule, LINK_MOTION), S + 20 * MS + 1);
    check_opening(schedule, LINK_MOTION, 20 * MS);
    check_opening(schedule, LINK_CONTROL, 20 * MS); // its share would take 48.6 ms
    // A share that is nearly saved up opens sooner than the debt is paid: 5 % and 2 % of the time.
    schedule.share_ns[LINK_MOTION] = BLOCK_NS - 100000;
    schedule.share_ns[LINK_CONTROL] = BLOCK_NS - 100000;
    schedule.share_ns[LINK_BULK] = BLOCK_NS - 100000;
    CHECK_EQUAL(schedule_opens_at(&schedule, LINK_CONTROL), S + 2 * MS + 1);
    CHECK_EQUAL(schedule_opens_at(&schedule, LINK_BULK), S + 5 * MS + 1);
    CHECK_EQUAL(schedule_opens_at(&schedule, LINK_MOTION), S + 20 * MS + 1);
}

static void what_is_sent_is_counted_and_paid(void) {
    struct schedule schedule = fresh();
    schedule.share_ns[LINK_CONTROL] = 300 * BIT_NS;
    schedule_sent(&schedule, LINK_CONTROL, 100);
    schedule_sent(&schedule, LINK_CONTROL, 50);
    CHECK_EQUAL(schedule.sent_bits[LINK_CONTROL], 150);
    CHECK_EQUAL(schedule.sent_bits[LINK_BULK], 0);
    CHECK_EQUAL(schedule.credit_ns, -150 * BIT_NS);
    CHECK_EQUAL(schedule.share_ns[LINK_CONTROL], 150 * BIT_NS);
    CHECK_EQUAL(schedule.line_free_ns, S + 150 * BIT_NS); // one behind the other
    schedule_sent(&schedule, LINK_CONTROL, 151);
    CHECK_EQUAL(schedule.share_ns[LINK_CONTROL], 0); // no debt of a share
    schedule_advance(&schedule, S + 5 * MS);
    schedule_sent(&schedule, LINK_BULK, 10);
    CHECK_EQUAL(schedule.line_free_ns, S + 5 * MS + 10 * BIT_NS); // the line was idle meanwhile

    struct schedule unknown = bus(0, 0, 0, 0); // without a bit rate nothing is counted
    schedule_sent(&unknown, LINK_BULK, 100);
    schedule_received(&unknown, SCHEDULE_DATA, 100);
    schedule_advance(&unknown, S + MS);
    CHECK_EQUAL(unknown.now_ns, S + MS);
    CHECK_EQUAL(unknown.sent_bits[LINK_BULK], 0);
    CHECK_EQUAL(unknown.received_bits, 0);
    CHECK_EQUAL(unknown.credit_ns, 0);
    CHECK_EQUAL(unknown.share_ns[LINK_CONTROL], 0);
    CHECK_EQUAL(schedule_recent(&unknown, LINK_BULK), 0);
    unknown.credit_ns = -1;
    CHECK_EQUAL(schedule_allowed(&unknown), LINK_ALL);
}

static void a_serial_line_pays_nothing_for_what_it_receives(void) {
    struct schedule serial = bus(250000, 0, 0, 1);
    schedule_sent(&serial, LINK_CONTROL, 100);
    uint64_t free_ns = serial.line_free_ns;
    int64_t credit_ns = serial.credit_ns;
    schedule_received(&serial, SCHEDULE_DATA, 100);
    CHECK_EQUAL(serial.received_bits, 100);
    CHECK_EQUAL(serial.credit_ns, credit_ns);
    CHECK_EQUAL(serial.line_free_ns, free_ns);
    struct schedule can = fresh();
    schedule_received(&can, SCHEDULE_DATA, 100);
    CHECK_EQUAL(can.credit_ns, -100 * BIT_NS);
    CHECK_EQUAL(can.line_free_ns, S); // nothing of ours waited behind it
    schedule_sent(&can, LINK_CONTROL, 100);
    schedule_received(&can, SCHEDULE_DATA, 30);
    CHECK_EQUAL(can.line_free_ns, S + 130 * BIT_NS);
}

static void the_time_held_back_goes_on(void) {
    struct schedule schedule = fresh();
    schedule_held(&schedule, 1);
    schedule_advance(&schedule, S + 3 * MS);
    schedule_advance(&schedule, S + 5 * MS); // each stretch counts once
    CHECK_EQUAL(schedule.held_ns, 5 * MS);
    schedule_held(&schedule, 0);
    schedule_advance(&schedule, S + 6 * MS);
    CHECK_EQUAL(schedule.held_ns, 5 * MS);
}

// ---------------------------------------------------------------------------------------------------- queue

static void frames_that_wait_are_rounded_up(void) {
    struct schedule schedule = fresh();
    CHECK_EQUAL(schedule_queued(&schedule, UINT64_MAX), 0);
    schedule_sent(&schedule, LINK_CONTROL, 120);
    CHECK_EQUAL(schedule_queued(&schedule, UINT64_MAX), 1);
    schedule_sent(&schedule, LINK_CONTROL, 1);
    CHECK_EQUAL(schedule_queued(&schedule, UINT64_MAX), 2);
    CHECK_EQUAL(schedule_queued(&schedule, 1), 2);
    CHECK_EQUAL(schedule_queued(&schedule, 3), 3); // what is reported, when it is more
    schedule_advance(&schedule, S + 121 * BIT_NS - 1);
    CHECK_EQUAL(schedule_queued(&schedule, 0), 1);
    schedule_advance(&schedule, S + 121 * BIT_NS);
    CHECK_EQUAL(schedule_queued(&schedule, 0), 0);
    CHECK_EQUAL(schedule_room(&schedule, 5), 1);
    CHECK_EQUAL(schedule_room(&schedule, 6), 0);
    CHECK_EQUAL(schedule_room(&schedule, 7), 0);
}

// Half of the queue, rounded up, has left when it is looked at again; of a long one all but 3 frames, which
// keep the bus busy meanwhile.
static void a_full_queue_is_looked_at_before_it_is_empty(void) {
    struct schedule schedule = bus(BITRATE, 0, 5, 0);
    CHECK_EQUAL(schedule_room_at(&schedule), S + 3 * FRAME_NS);
    schedule = bus(BITRATE, 0, 6, 0);
    CHECK_EQUAL(schedule_room_at(&schedule), S + 3 * FRAME_NS);
    schedule = bus(BITRATE, 0, 7, 0);
    CHECK_EQUAL(schedule_room_at(&schedule), S + 4 * FRAME_NS);
    schedule = bus(BITRATE, 0, 8, 0);
    CHECK_EQUAL(schedule_room_at(&schedule), S + 5 * FRAME_NS);
    schedule = bus(BITRATE, 0, 1, 0);
    CHECK_EQUAL(schedule_room_at(&schedule), S + FRAME_NS);
    schedule = bus(0, 0, 5, 0);
    CHECK_EQUAL(schedule_room_at(&schedule), S + MS);
    schedule = bus(250000, 0, 40, 1); // bytes of 40 µs
    CHECK_EQUAL(schedule_room_at(&schedule), S + 20 * 40000);
}

// After 7 ms without an acknowledgement a line that is free is left alone for the length of one frame.
static void the_pause_begins_and_ends_to_the_nanosecond(void) {
    struct schedule schedule = fresh();
    schedule_advance(&schedule, S + 7 * MS - 1);
    CHECK(!schedule_pause(&schedule, S));
    schedule_advance(&schedule, S + 7 * MS);
    CHECK(!schedule_pause(&schedule, S + 1));
    CHECK(schedule_pause(&schedule, S));
    CHECK_EQUAL(schedule.pause_ns, S + 7 * MS + FRAME_NS);
    uint64_t end_ns = schedule.pause_ns;
    schedule_advance(&schedule, end_ns - 1);
    CHECK(schedule_pause(&schedule, UINT64_MAX)); // answered or not
    schedule_advance(&schedule, end_ns);
    CHECK(!schedule_pause(&schedule, S));
    CHECK_EQUAL(schedule.pause_ns, 0);
    schedule_advance(&schedule, end_ns + 7 * MS - 1);
    CHECK(!schedule_pause(&schedule, S));
    schedule_advance(&schedule, end_ns + 7 * MS);
    CHECK(schedule_pause(&schedule, S));
    struct schedule serial = bus(250000, 0, 0, 1);
    schedule_advance(&serial, 2 * S);
    CHECK(!schedule_pause(&serial, S)); // who answers has a line of his own
}

static void deadlines_order_what_is_not_overdue(void) {
    uint64_t now = 100 * MS;
    struct link_offer at_now = {now, LINK_CONTROL, 0}, overdue = {now - 1, LINK_CONTROL, 0};
    struct link_offer soon = {now + 1, LINK_CONTROL, 0};
    CHECK(schedule_before(&at_now, &soon, now) && !schedule_before(&soon, &at_now, now));
    CHECK(schedule_before(&overdue, &soon, now));
    CHECK(!schedule_before(&overdue, &at_now, now)); // overdue alike
    struct link_offer late_motion = {now - 5, LINK_MOTION, 0}, later_motion = {now - 4, LINK_MOTION, 0};
    CHECK(schedule_before(&late_motion, &later_motion, now)); // motion has true deadlines
    struct link_offer urgent = {now + 50, LINK_CONTROL, 1};   // an urgent command
    CHECK(schedule_before(&urgent, &late_motion, now) && !schedule_before(&late_motion, &urgent, now));
    struct link_offer early_urgent = {now - 9, LINK_CONTROL, 1}, late_urgent = {now - 8, LINK_CONTROL, 1};
    CHECK(schedule_before(&early_urgent, &late_urgent, now) &&
          !schedule_before(&late_urgent, &early_urgent, now));
}

// -------------------------------------------------------------------------------------------------- figures

static void a_rate_is_of_the_time_that_was_seen(void) {
    struct schedule schedule;
    schedule_init(&schedule, BITRATE, 0, 0, 0, 3 * S + 40 * MS); // within a slot of 100 ms
    schedule_sent(&schedule, LINK_CONTROL, 500);
    CHECK_EQUAL(schedule_recent(&schedule, LINK_CONTROL), 5000); // a tenth of a second at least
    CHECK_EQUAL(schedule_recent(&schedule, LINK_BULK), 0);
    schedule_advance(&schedule, 3 * S + 140 * MS);
    CHECK_EQUAL(schedule_recent(&schedule, LINK_CONTROL), 5000);
    schedule_advance(&schedule, 3 * S + 240 * MS); // 0.2 s
    CHECK_EQUAL(schedule_recent(&schedule, LINK_CONTROL), 2500);
    schedule_advance(&schedule, 3 * S + 540 * MS);
    CHECK_EQUAL(schedule_recent(&schedule, LINK_CONTROL), 1000);
    schedule_advance(&schedule, 4 * S + 50 * MS); // ten whole slots and half of the eleventh
    CHECK_EQUAL(schedule_recent(&schedule, LINK_CONTROL), 500 * 1000 / 1010);
    schedule_advance(&schedule, 4 * S + 99 * MS);
    CHECK_EQUAL(schedule_recent(&schedule, LINK_CONTROL), 500000 / 1059);
    schedule_advance(&schedule, 4 * S + 100 * MS); // its slot is filled again
    CHECK_EQUAL(schedule_recent(&schedule, LINK_CONTROL), 0);
}

static void a_long_sleep_forgets_all_slots(void) {
    for (uint64_t slots = SCHEDULE_SLOTS - 1; slots <= SCHEDULE_SLOTS + 1; slots++) {
        struct schedule schedule = fresh();
        schedule_sent(&schedule, LINK_CONTROL, 500);
        schedule_advance(&schedule, S + slots * 100 * MS);
        CHECK_EQUAL(schedule_recent(&schedule, LINK_CONTROL), slots < SCHEDULE_SLOTS ? 500 : 0);
        schedule_sent(&schedule, LINK_CONTROL, 70);
        CHECK_EQUAL(schedule_recent(&schedule, LINK_CONTROL), slots < SCHEDULE_SLOTS ? 570 : 70);
    }
}

static void check_near(double value, double wanted) {
    CHECK(value > wanted - 1e-9 && value < wanted + 1e-9);
}

static void what_is_left_for_motion(void) {
    struct schedule schedule = fresh();
    check_near(schedule_left_for_motion(&schedule), 0.9);
    schedule_sent(&schedule, LINK_CONTROL, 5000); // in a tenth of a second: 10 % of the line
    check_near(schedule_left_for_motion(&schedule), 0.8);
    schedule_sent(&schedule, LINK_BULK, 5000); // gives way
    schedule_received(&schedule, SCHEDULE_WEAK, 5000);
    schedule_received(&schedule, SCHEDULE_ACKS, 5000);
    check_near(schedule_left_for_motion(&schedule), 0.8);
    schedule_received(&schedule, SCHEDULE_DATA, 10000);
    check_near(schedule_left_for_motion(&schedule), 0.6);
    schedule_received(&schedule, SCHEDULE_DATA, 28000);
    check_near(schedule_left_for_motion(&schedule), 0.04);
    schedule_received(&schedule, SCHEDULE_DATA, 2000);
    check_near(schedule_left_for_motion(&schedule), 0.02); // never nothing
    struct schedule serial = bus(BITRATE, 0, 0, 1);
    schedule_received(&serial, SCHEDULE_DATA, 20000); // comes on another line
    check_near(schedule_left_for_motion(&serial), 0.9);
    struct schedule unknown = bus(0, 0.5, 0, 0);
    check_near(schedule_left_for_motion(&unknown), 0.5);
}

int main(void) {
    settings_and_defaults();
    credit_grows_by_the_ceiling_up_to_a_block();
    debt_has_a_bound();
    where_each_class_is_closed();
    openings_are_promised_exactly();
    what_is_sent_is_counted_and_paid();
    a_serial_line_pays_nothing_for_what_it_receives();
    the_time_held_back_goes_on();
    frames_that_wait_are_rounded_up();
    a_full_queue_is_looked_at_before_it_is_empty();
    the_pause_begins_and_ends_to_the_nanosecond();
    deadlines_order_what_is_not_overdue();
    a_rate_is_of_the_time_that_was_seen();
    a_long_sleep_forgets_all_slots();
    what_is_left_for_motion();
    return 0;
}
