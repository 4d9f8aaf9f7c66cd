// SPDX-License-Identifier: Apache-2.0
// sources: nodes/link/core/schedule.c
// Budget, order and queue bound of a bus, by themselves: 500 kbit/s, so a bit lasts 2 µs.
#include "tests/check.h"

#include "nodes/link/core/schedule.h"

#define MS 1000000ULL
#define S (1000 * MS)
#define BIT_NS 2000

enum { BITRATE = 500000, BLOCK_BITS = 1000 };

static struct schedule fresh(uint64_t now) {
    struct schedule schedule;
    schedule_init(&schedule, BITRATE, 0, 0, 0, now);
    return schedule;
}

static int may(const struct schedule *schedule, enum link_class kind) {
    return (schedule_allowed(schedule) >> kind & 1) != 0;
}

// Sends KIND whenever it may for a second, beside OTHERS bits of received data each ms; returns its share.
static double share_of(enum link_class kind, uint32_t others) {
    struct schedule schedule = fresh(S);
    uint64_t now = S;
    for (; now < 3 * S; now += MS / 10) {
        schedule_advance(&schedule, now);
        if (now % MS == 0 && others)
            schedule_received(&schedule, SCHEDULE_DATA, others);
        while (may(&schedule, kind))
            schedule_sent(&schedule, kind, BLOCK_BITS);
    }
    return (double)schedule_recent(&schedule, kind) / BITRATE;
}

static void check_near(double value, double wanted) {
    CHECK(value > wanted - 0.01 && value < wanted + 0.015);
}

static void shares_are_as_promised(void) {
    check_near(share_of(LINK_BULK, 0), 0.9);
    check_near(share_of(LINK_BULK, 200), 0.5); // 40 % received
    check_near(share_of(LINK_BULK, 450), 0.02);
    check_near(share_of(LINK_BULK, 500), 0.02);
    check_near(share_of(LINK_CONTROL, 200), 0.51); // and what it overdraws
    check_near(share_of(LINK_CONTROL, 500), 0.05);
    check_near(share_of(LINK_MOTION, 0), 0.91); // sent ahead
}

static void bulk_comes_in_no_bursts(void) {
    struct schedule schedule = fresh(S);
    schedule_advance(&schedule, 100 * S); // long silence saves up nothing
    unsigned blocks = 0;
    for (; may(&schedule, LINK_BULK); blocks++)
        schedule_sent(&schedule, LINK_BULK, BLOCK_BITS);
    CHECK(blocks >= 1 && blocks <= 3);
    uint64_t opens_ns = schedule_opens_at(&schedule, LINK_BULK);
    CHECK(opens_ns > 100 * S && opens_ns < 100 * S + 10 * MS);
    schedule_advance(&schedule, opens_ns - 1000);
    CHECK(!may(&schedule, LINK_BULK));
    schedule_advance(&schedule, opens_ns + 1000);
    CHECK(may(&schedule, LINK_BULK));
}

static void an_opening_is_never_promised_in_the_past(void) {
    for (int kind = 0; kind < LINK_CLASSES; kind++) {
        struct schedule schedule = fresh(1);
        uint64_t now = 1;
        for (uint32_t i = 0; i < 20000; i++) {
            now += i * 7919 % 300000;
            schedule_advance(&schedule, now);
            if (may(&schedule, (enum link_class)kind))
                schedule_sent(&schedule, (enum link_class)(i % 3), i * 31 % 1300);
            else
                CHECK(schedule_opens_at(&schedule, (enum link_class)kind) > now);
            schedule_received(&schedule, SCHEDULE_ACKS, i % 130);
        }
    }
}

static void what_is_held_back_is_counted(void) {
    struct schedule schedule = fresh(S);
    schedule_held(&schedule, 1);
    schedule_advance(&schedule, S + 5 * MS);
    CHECK_EQUAL(schedule.held_ns, 5 * MS);
    schedule_held(&schedule, 0);
    schedule_advance(&schedule, S + 9 * MS);
    CHECK_EQUAL(schedule.held_ns, 5 * MS);
}

static void the_queue_is_bounded_by_report_and_by_estimate(void) {
    struct schedule schedule = fresh(S);
    CHECK_EQUAL(schedule.queue_frames, 6); // 1.5 ms
    CHECK_EQUAL(schedule_room(&schedule, 0), 6);
    CHECK_EQUAL(schedule_room(&schedule, 4), 2);
    CHECK_EQUAL(schedule_room(&schedule, 60), 0);
    for (int i = 0; i < 5; i++)
        schedule_sent(&schedule, LINK_MOTION, 120);
    CHECK_EQUAL(schedule_room(&schedule, 0), 1); // it must be in the adapter
    CHECK_EQUAL(schedule_room(&schedule, UINT64_MAX), 1);
    schedule_advance(&schedule, S + 2 * 120 * BIT_NS);
    CHECK_EQUAL(schedule_room(&schedule, UINT64_MAX), 3);
    schedule_received(&schedule, SCHEDULE_DATA, 120); // that was on the line meanwhile
    CHECK_EQUAL(schedule_room(&schedule, UINT64_MAX), 2);
    schedule_advance(&schedule, 2 * S);
    CHECK_EQUAL(schedule_room(&schedule, UINT64_MAX), 6);
    CHECK(schedule_room_at(&schedule) > 2 * S);
    struct schedule serial;
    schedule_init(&serial, 250000, 0, 0, 1, S);
    CHECK(schedule_room(&serial, 1000) == UINT64_MAX);
    schedule_init(&serial, 250000, 0, 40, 1, S);
    CHECK_EQUAL(schedule_room(&serial, 30), 10);
}

static void an_unknown_bit_rate_allows_everything(void) {
    struct schedule schedule;
    schedule_init(&schedule, 0, 0, 0, 0, S);
    schedule_sent(&schedule, LINK_BULK, 1000000);
    CHECK_EQUAL(schedule_allowed(&schedule), LINK_ALL);
    CHECK(schedule_room(&schedule, 1000) == UINT64_MAX);
    CHECK(!schedule_pause(&schedule, 1));
}

static void a_line_that_is_not_answered_pauses(void) {
    struct schedule schedule = fresh(S);
    CHECK(!schedule_pause(&schedule, UINT64_MAX));
    CHECK(!schedule_pause(&schedule, S));
    schedule_advance(&schedule, S + 7 * MS);
    schedule_sent(&schedule, LINK_MOTION, 500); // 1 ms
    CHECK(schedule_pause(&schedule, S));
    uint64_t until_ns = S + 8 * MS + 120 * BIT_NS;
    CHECK_EQUAL(schedule_room_at(&schedule), until_ns);
    schedule_advance(&schedule, until_ns - 1);
    CHECK(schedule_pause(&schedule, S));
    schedule_advance(&schedule, until_ns);
    CHECK(!schedule_pause(&schedule, S)); // and not again at once, answered or not
    schedule_advance(&schedule, until_ns + 7 * MS);
    CHECK(schedule_pause(&schedule, S));
}

static void order(void) {
    uint64_t now = 100 * MS;
    struct link_offer urgent = {now - 1, LINK_MOTION, 1}, earlier = {now - 5, LINK_MOTION, 1};
    struct link_offer ahead = {now + MS, LINK_MOTION, 0}, asked = {now + 2 * MS, LINK_CONTROL, 0};
    struct link_offer overdue = {now - 50 * MS, LINK_CONTROL, 0}, longer = {now - 90 * MS, LINK_CONTROL, 0};
    CHECK(schedule_before(&earlier, &urgent, now) && !schedule_before(&urgent, &earlier, now));
    CHECK(schedule_before(&urgent, &overdue, now) && !schedule_before(&overdue, &urgent, now));
    CHECK(schedule_before(&ahead, &asked, now) && !schedule_before(&asked, &ahead, now));
    CHECK(schedule_before(&overdue, &ahead, now));
    // A flood that was queued first is not more overdue: neither goes before the other, the turn goes round.
    CHECK(!schedule_before(&longer, &overdue, now) && !schedule_before(&overdue, &longer, now));
}

static void recent_is_a_second(void) {
    struct schedule schedule = fresh(S);
    uint64_t now = S;
    for (int ms = 0; ms < 5000; ms++) {
        schedule_advance(&schedule, now += MS);
        schedule_received(&schedule, SCHEDULE_DATA, 300);
    }
    CHECK(schedule_recent(&schedule, SCHEDULE_DATA) > 298000);
    CHECK(schedule_recent(&schedule, SCHEDULE_DATA) < 302000);
    CHECK(schedule_left_for_motion(&schedule) > 0.295 && schedule_left_for_motion(&schedule) < 0.305);
    schedule_advance(&schedule, now + 2 * S);
    CHECK_EQUAL(schedule_recent(&schedule, SCHEDULE_DATA), 0);
    CHECK_EQUAL(schedule.received_bits, 1500000);
}

int main(void) {
    shares_are_as_promised();
    bulk_comes_in_no_bursts();
    an_opening_is_never_promised_in_the_past();
    what_is_held_back_is_counted();
    the_queue_is_bounded_by_report_and_by_estimate();
    an_unknown_bit_rate_allows_everything();
    a_line_that_is_not_answered_pauses();
    order();
    recent_is_a_second();
    return 0;
}
