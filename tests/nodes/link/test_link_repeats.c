// SPDX-License-Identifier: Apache-2.0
// sources: firmware/wire/*.c nodes/link/core/link*.c nodes/link/core/queue.c
// What is not acknowledged: when it goes again and how, what naks say, and when the link is lost.
#include "tests/nodes/link/link_scene.h"

static void time_passes(struct scene *scene, uint64_t at_ns) {
    scene->now = at_ns;
    link_handle_timer(&scene->link, scene->now);
}

static void nak(struct scene *scene) {
    answer(scene, scene->link.first, 0);
}

// SIZE bytes of content in a block of their own.
static void block_goes(struct scene *scene, char tag, size_t size) {
    char content[WIRE_BLOCK_MAX] = {0};
    memset(content, tag, size);
    control(scene, tag, size);
    check_goes(scene, content);
}

// ------------------------------------------------------------------------------------------------ timeouts

static void each_timeout_doubles_the_next_up_to_an_eighth_of_what_loses_the_link(void) {
    static const uint64_t waits_ms[] = {20, 40, 80, 125, 125, 125, 125, 125, 125};
    struct scene scene;
    open_running(&scene, WINDOW);
    struct link_stats before = stats_of(&scene);
    block_goes(&scene, 'a', 3);
    uint64_t sent_ns = scene.now;
    for (unsigned i = 0; i < 9; i++) {
        CHECK_EQUAL(link_unanswered_since(&scene.link), scene.now);
        CHECK_EQUAL(stats_of(&scene).rto_ns, waits_ms[i] * MS);
        uint64_t due_ns = scene.now + waits_ms[i] * MS;
        CHECK_EQUAL(deadline_of(&scene), due_ns);
        time_passes(&scene, due_ns - 1);
        CHECK_EQUAL(go(&scene), 0);
        CHECK_EQUAL(offer_of(&scene, LINK_ALL).kind, LINK_CLASSES);
        time_passes(&scene, due_ns);
        CHECK_EQUAL(stats_of(&scene).timeouts, i + 1);
        CHECK_EQUAL(link_unanswered_since(&scene.link), NEVER);
        CHECK_EQUAL(deadline_of(&scene), sent_ns + SECOND);
        CHECK_OFFER(&scene, LINK_CONTROL, 0, 0);
        if (i == 0)
            check_block(&scene, go(&scene), 56, "aaa");
        else // what was lost twice goes twice
            check_twice(&scene, go(&scene), 56, "aaa");
    }
    struct link_stats stats = stats_of(&scene);
    CHECK_EQUAL(stats.blocks_sent - before.blocks_sent, 10);
    CHECK_EQUAL(stats.bytes_sent - before.bytes_sent, 8 + 9 * 64 + 8 * 9);
    CHECK_EQUAL(stats.blocks_repeated, 9);
    CHECK_EQUAL(stats.bytes_repeated, 9 * 64 + 8 * 9);
    CHECK_EQUAL(stats.commands_sent - before.commands_sent, 1);
    CHECK_EQUAL(scene.link.in_flight_bytes, 73);
    CHECK_EQUAL(deadline_of(&scene), sent_ns + SECOND);
    time_passes(&scene, sent_ns + SECOND - 1);
    CHECK_EQUAL(scene.link.state, LINK_RUNNING);
    time_passes(&scene, sent_ns + SECOND);
    CHECK_EQUAL(scene.link.state, LINK_LOST);
    CHECK_EQUAL(scene.link.cause, LINK_CAUSE_SILENT);
}

// An acknowledgement of what was repeated may be of either transmission. The time since the last one is not
// longer than a round trip: it is measured if it is longer than was known, and ends the doublings if it could
// be one.
static void the_last_repeat_ends_the_doublings_if_it_can_have_been_answered(void) {
    static const struct {
        uint64_t after_ns, srtt_ns, rto_ns;
    } cases[] = {
        {2 * MS - 1, 4 * MS, 40 * MS}, // an earlier one was answered late: the timeout is too short
        {2 * MS, 4 * MS, 20 * MS},
        {4 * MS, 4 * MS, 20 * MS},
        {12 * MS, 5 * MS, 29 * MS - 2 * MS},
    };
    for (size_t i = 0; i < sizeof cases / sizeof *cases; i++) {
        struct scene scene;
        open_link(&scene, WINDOW, SECOND);
        run_up(&scene, 4 * MS);
        for (unsigned k = 0; k < 20; k++) { // until the deviation is small
            block_goes(&scene, 'z', 1);
            scene.now += 4 * MS;
            acknowledge_all(&scene);
        }
        uint64_t rttvar_ns = stats_of(&scene).rttvar_ns;
        CHECK(rttvar_ns < MS / 10);
        block_goes(&scene, 'a', 3);
        time_passes(&scene, scene.now + 20 * MS);
        CHECK_EQUAL(go(&scene), 64);
        CHECK_EQUAL(stats_of(&scene).rto_ns, 40 * MS);
        scene.now += cases[i].after_ns;
        acknowledge_all(&scene);
        CHECK_EQUAL(stats_of(&scene).srtt_ns, cases[i].srtt_ns);
        if (cases[i].after_ns <= 4 * MS)
            CHECK_EQUAL(stats_of(&scene).rto_ns, cases[i].rto_ns);
        CHECK_EQUAL(scene.link.backoff, cases[i].after_ns < 2 * MS);
    }
}

// An acknowledgement may get lost; the node's next answer replaces it, and its time is no round trip.
static void no_sample_moves_the_mean_far(void) {
    static const struct {
        uint64_t trip_ns, sample_ns;
    } steps[] = {{13 * MS, 13 * MS}, {14 * MS, 14 * MS}, {15 * MS, 14 * MS}, {900 * MS, 14 * MS}};
    for (size_t i = 0; i < sizeof steps / sizeof *steps; i++) {
        struct scene scene;
        open_link(&scene, WINDOW, SECOND);
        run_up(&scene, 4 * MS);
        block_goes(&scene, 'a', 3);
        uint64_t srtt_ns = stats_of(&scene).srtt_ns;
        CHECK_EQUAL(srtt_ns, 4 * MS);
        scene.now += steps[i].trip_ns;
        acknowledge_all(&scene);
        CHECK_EQUAL(stats_of(&scene).srtt_ns, (7 * srtt_ns + steps[i].sample_ns) / 8);
    }
}

// ---------------------------------------------------------------------------------------------------
// deadlines

enum { HERTZ = 1000, TICKS = 1000000 };

// A running link with round trips of 1 ns, whose node's clock counts ms.
static void open_timed(struct scene *scene) {
    open_running(scene, WINDOW);
    CHECK_EQUAL(link_set_clock(&scene->link, HERTZ, scene->now, TICKS), LINK_OK);
}

// A timeout is a sixteenth of the time left, but neither longer than others nor shorter than an answer takes.
static void a_timeout_knows_the_deadline(void) {
    static const struct {
        unsigned left_ms;
        uint64_t timeout_ns;
    } cases[] = {{1000, 20 * MS}, {320, 20 * MS}, {319, 19937500}, {160, 10 * MS},
                 {64, 4 * MS},    {5, 4 * MS},    {0, 20 * MS}}; // too late
    for (size_t i = 0; i < sizeof cases / sizeof *cases; i++) {
        struct scene scene;
        open_timed(&scene);
        motion(&scene, 'm', 3, 0, TICKS + cases[i].left_ms);
        check_goes(&scene, "mmm");
        CHECK_EQUAL(deadline_of(&scene), scene.now + cases[i].timeout_ns);
        uint64_t at_ns = deadline_of(&scene);
        time_passes(&scene, at_ns - 1);
        CHECK_EQUAL(stats_of(&scene).timeouts, 0);
        time_passes(&scene, at_ns);
        CHECK_EQUAL(stats_of(&scene).timeouts, 1);
    }
}

// The earliest command counts, of any class, in flight or waiting for it.
static void whatever_waits_has_a_deadline(void) {
    struct scene scene;
    open_timed(&scene);
    control(&scene, 'c', 3);
    check_goes(&scene, "ccc");
    CHECK_EQUAL(deadline_of(&scene), scene.now + 20 * MS);
    CHECK_EQUAL(try_send(&scene, LINK_CONTROL, 'd', 3, 0, TICKS + 240), LINK_OK);
    check_goes(&scene, "ddd");
    CHECK_EQUAL(deadline_of(&scene), scene.now + 15 * MS);
    motion(&scene, 'm', 3, TICKS + 50, TICKS + 160);
    motion(&scene, 'n', 3, TICKS + 50, TICKS + 80); // not at the front
    CHECK_EQUAL(deadline_of(&scene), scene.now + 10 * MS);
}

// A repeat whose commands are due within 200 ms goes twice; the blocks behind it do not.
static void what_is_due_soon_is_repeated_twice(void) {
    static const uint64_t left_ns[] = {200 * MS, 200 * MS - 1, 1, 0};
    for (size_t i = 0; i < sizeof left_ns / sizeof *left_ns; i++) {
        const int soon = left_ns[i] && left_ns[i] < 200 * MS;
        struct scene scene;
        open_timed(&scene);
        const uint64_t due_ns = scene.now + 240 * MS;
        motion(&scene, 'm', 59, 0, TICKS + 240);
        motion(&scene, 'n', 3, 0, TICKS + 240);
        CHECK_EQUAL(go(&scene), 64); // the first transmission is one
        check_goes(&scene, "nnn");
        uint64_t outstanding = scene.link.naks_outstanding;
        time_passes(&scene, due_ns - left_ns[i]);
        char content[WIRE_CONTENT_MAX + 1] = {0};
        memset(content, 'm', WIRE_CONTENT_MAX);
        size_t size = go(&scene);
        if (soon)
            check_twice(&scene, size, 2, content); // 66 bytes: the gap is no whole frame
        else
            check_block(&scene, size, 1, content);
        check_goes(&scene, "nnn");
        CHECK_EQUAL(scene.link.naks_outstanding, outstanding + 2 + (uint64_t)soon);
        CHECK_EQUAL(scene.link.in_flight_bytes, size + 8);
        acknowledge_all(&scene);
        CHECK_EQUAL(scene.link.in_flight_bytes, 0);
    }
}

static void a_copy_that_does_not_fit_the_window_is_left_out(void) {
    for (uint64_t window = 136; window <= 137; window++) {
        struct scene scene;
        open_timed(&scene);
        CHECK_EQUAL(link_set_receive_window(&scene.link, window), LINK_OK);
        motion(&scene, 'm', 59, 0, TICKS + 100);
        CHECK_EQUAL(go(&scene), 64);
        time_passes(&scene, deadline_of(&scene));
        CHECK_EQUAL(go(&scene), window < 137 ? 66 : 137);
    }
}

// A nak that a repeat may have caused says that the node answers: it has the time of an answer for another
// one.
static void an_ignored_nak_shortens_the_timeout(void) {
    struct scene scene;
    open_running(&scene, WINDOW);
    block_goes(&scene, 'a', 3);
    time_passes(&scene, scene.now + 20 * MS);
    CHECK(go(&scene) > 0);
    for (unsigned shift = 1; shift <= 3; shift++) { // doubled, twice at most
        scene.now += MS;
        nak(&scene);
        CHECK_EQUAL(stats_of(&scene).naks, shift);
        CHECK_EQUAL(go(&scene), 0);
        CHECK_EQUAL(deadline_of(&scene), scene.now + (4 * MS << (shift < 2 ? shift : 2)));
        time_passes(&scene, deadline_of(&scene));
        check_twice(&scene, go(&scene), 56, "aaa");
    }
    scene.now += MS;
    nak(&scene);
    scene.now += MS;
    acknowledge_all(&scene);
    control(&scene, 'b', 1); // which that nak says nothing about
    check_goes(&scene, "b");
    CHECK_EQUAL(deadline_of(&scene), scene.now + 20 * MS);
}

// -------------------------------------------------------------------------------------------- round trips

static void round_trips_make_the_timeout(void) {
    static const struct {
        uint64_t trip_ns, srtt_ns, rttvar_ns, rto_ns;
    } steps[] = {
        {10000000, 10000000, 5000000, 30000000}, // the first: half of it as the deviation
        {10000000, 10000000, 3750000, 25000000}, {30000000, 11250000, 5312500, 32500000},
        {2500000, 10156250, 6171875, 34843750},  {11250000, 10292968, 4902343, 29902340},
        {0, 9006347, 6249999, 34006343},
    };
    struct scene scene;
    open_link(&scene, WINDOW, SECOND);
    control(&scene, 'a', 1);
    CHECK_EQUAL(go(&scene), 64);
    acknowledge_all(&scene);
    CHECK_EQUAL(go(&scene), 5); // the second question is the first that is measured
    for (size_t i = 0; i < sizeof steps / sizeof *steps; i++) {
        scene.now += steps[i].trip_ns;
        acknowledge_all(&scene);
        struct link_stats stats = stats_of(&scene);
        if (steps[i].trip_ns) {
            CHECK_EQUAL(stats.srtt_ns, steps[i].srtt_ns);
            CHECK_EQUAL(stats.rttvar_ns, steps[i].rttvar_ns);
            CHECK_EQUAL(stats.rto_ns, steps[i].rto_ns);
        } else { // at once is one ns
            CHECK_EQUAL(stats.srtt_ns, (7 * 10292968ULL + 1) / 8);
            CHECK_EQUAL(stats.rttvar_ns, (3 * 4902343ULL + 10292967) / 4);
        }
        if (i)
            control(&scene, 'a', 1);
        CHECK_EQUAL(go(&scene), 6);
    }
}

// An acknowledgement of several blocks measures the last of them.
static void the_last_block_of_several_is_measured(void) {
    struct scene scene;
    open_running(&scene, WINDOW);
    block_goes(&scene, 'a', 3);
    scene.now += 8 * MS;
    block_goes(&scene, 'b', 3);
    scene.now += 4 * MS;
    acknowledge_all(&scene);
    CHECK_EQUAL(stats_of(&scene).srtt_ns, (7 + 4 * MS) / 8);
    CHECK_EQUAL(stats_of(&scene).rttvar_ns, (4 * MS - 1) / 4);
}

// ------------------------------------------------------------------------------------- what a repeat is like

// The first block of a repeat fills a node's buffer up that waits for the rest of a damaged one.
static void a_timeout_flushes_the_node(void) {
    static const struct {
        size_t sizes[3], lead;
    } cases[] = {
        {{10}, 49},    {{30, 19}, 5}, {{30, 23}, 1}, {{30, 24}, 1},
        {{30, 25}, 1}, {{58}, 1},     {{59}, 1},     {{1, 2, 3}, 43},
    };
    struct scene scene;
    open_running(&scene, WINDOW);
    for (unsigned i = 0; i < 20; i++) { // every slot has held a block of some length
        block_goes(&scene, 'z', 40);
        acknowledge_all(&scene);
    }
    for (size_t i = 0; i < sizeof cases / sizeof *cases; i++) {
        for (unsigned k = 0; k < 3 && cases[i].sizes[k]; k++)
            block_goes(&scene, 'a', cases[i].sizes[k]);
        time_passes(&scene, deadline_of(&scene));
        for (unsigned k = 0; k < 3 && cases[i].sizes[k]; k++) {
            char content[WIRE_BLOCK_MAX] = {0};
            memset(content, 'a', cases[i].sizes[k]);
            check_block(&scene, go(&scene), k ? 0 : cases[i].lead, content);
        }
        CHECK_EQUAL(go(&scene), 0);
        acknowledge_all(&scene);
        CHECK_EQUAL(scene.link.in_flight_bytes, 0);
        block_goes(&scene, 'b', 3);
        acknowledge_all(&scene); // a sure round trip
    }
}

// Sync bytes count in the window: what no longer fits waits for its turn, and nothing new goes before it.
static void repeats_stay_within_the_window(void) {
    struct scene scene;
    open_running(&scene, 192);
    for (unsigned i = 0; i < 3; i++)
        block_goes(&scene, 'a', 59);
    control(&scene, 'b', 59);
    CHECK_EQUAL(go(&scene), 0);
    CHECK_EQUAL(scene.link.in_flight_bytes, 192);
    time_passes(&scene, scene.now + 20 * MS);
    CHECK_EQUAL(scene.link.in_flight_bytes, 0);
    CHECK_EQUAL(go(&scene), 65);
    CHECK_EQUAL(go(&scene), 64);
    CHECK_EQUAL(offer_of(&scene, LINK_ALL).kind, LINK_CLASSES);
    CHECK_EQUAL(go(&scene), 0);
    CHECK_EQUAL(deadline_of(&scene), scene.now + 40 * MS);
    answer(&scene, scene.link.first + 2, 0);
    CHECK_EQUAL(scene.link.in_flight_bytes, 0);
    CHECK_OFFER(&scene, LINK_CONTROL, 0, 0);
    CHECK_EQUAL(go(&scene), 64);
    CHECK_EQUAL(scene.link.in_flight_bytes, 64);
    CHECK_EQUAL(stats_of(&scene).bytes_repeated, 193);
    CHECK_EQUAL(go(&scene), 0);
    answer(&scene, scene.link.first + 1, 0);
    CHECK_EQUAL(go(&scene), 64);
    acknowledge_all(&scene);
    CHECK_EQUAL(scene.link.in_flight_bytes, 0);
}

// A gate that opens does not wake while a repeat waits for room.
static void what_waits_behind_a_repeat_wakes_nobody(void) {
    struct scene scene;
    open_running(&scene, 64);
    CHECK_EQUAL(link_set_clock(&scene.link, 512, scene.now, 1000), LINK_OK);
    block_goes(&scene, 'a', 59);
    motion(&scene, 'm', 1, 1014, 0); // 27 ms, and 2
    CHECK_EQUAL(deadline_of(&scene), scene.now + 20 * MS);
    time_passes(&scene, scene.now + 20 * MS);
    CHECK_EQUAL(deadline_of(&scene), scene.now + 980 * MS);
    CHECK_EQUAL(go(&scene), 65);
    CHECK_EQUAL(deadline_of(&scene), scene.now - 20 * MS + 14 * 1953125 + 2 * MS);
}

// A repeat goes at once, and before everything where motion is in it or waits behind it.
static void a_repeat_presses_where_motion_or_an_emergency_is_behind_it(void) {
    enum { CONTROL, BULK, MOTION, MOTION_UNTIMED, BEFORE_MOTION, BEFORE_UNTIMED, BEFORE_URGENT, CASES };
    static const struct {
        unsigned kind, urgent;
    } expected[CASES] = {
        [CONTROL] = {LINK_CONTROL, 0},       [BULK] = {LINK_BULK, 0},
        [MOTION] = {LINK_MOTION, 1},         [MOTION_UNTIMED] = {LINK_MOTION, 0},
        [BEFORE_MOTION] = {LINK_CONTROL, 1}, [BEFORE_UNTIMED] = {LINK_CONTROL, 0},
        [BEFORE_URGENT] = {LINK_CONTROL, 1},
    };
    for (int i = 0; i < CASES; i++) {
        struct scene scene;
        open_running(&scene, 64);
        if (i == MOTION || i == MOTION_UNTIMED)
            motion(&scene, 'm', 59, 0, i == MOTION ? 1 : 0);
        else if (i == BULK)
            bulk(&scene, 'b', 59);
        else
            control(&scene, 'c', 59);
        CHECK_EQUAL(go(&scene), 64);
        if (i == BEFORE_MOTION || i == BEFORE_UNTIMED)
            motion(&scene, 'm', 1, 0, i == BEFORE_MOTION ? 1 : 0);
        if (i == BEFORE_URGENT)
            CHECK_EQUAL(urgent(&scene, 'u', 1), LINK_OK);
        CHECK_EQUAL(offer_of(&scene, LINK_ALL).kind, LINK_CLASSES);
        time_passes(&scene, scene.now + 20 * MS);
        CHECK_OFFER(&scene, expected[i].kind, 0, expected[i].urgent);
        struct offered offered = offer_of(&scene, 0); // of a class that may not send, too
        CHECK_EQUAL(offered.kind, expected[i].kind);
        CHECK_EQUAL(go_of(&scene, 0), 65);
    }
}

// ---------------------------------------------------------------------------------------------------- naks

static void three_blocks_go(struct scene *scene) {
    block_goes(scene, 'a', 10);
    block_goes(scene, 'b', 20);
    block_goes(scene, 'c', 30);
}

// The first of them twice from the second time on.
static void three_blocks_go_again(struct scene *scene, size_t lead) {
    if (scene->link.blocks[scene->link.first % LINK_SLOTS].repeats)
        check_twice(scene, go(scene), lead, "aaaaaaaaaa");
    else
        check_block(scene, go(scene), lead, "aaaaaaaaaa");
    check_block(scene, go(scene), 0, "bbbbbbbbbbbbbbbbbbbb");
    check_block(scene, go(scene), 0, "cccccccccccccccccccccccccccccc");
    CHECK_EQUAL(go(scene), 0);
}

// Each block of a repeat may cause a nak that says nothing: as many are ignored, for the time of a timeout.
static void naks_that_repeats_may_cause_are_ignored(void) {
    struct scene scene;
    open_running(&scene, WINDOW);
    three_blocks_go(&scene);
    nak(&scene);
    nak(&scene); // the repeat is on its way already
    CHECK_EQUAL(scene.link.naks_outstanding, 3);
    three_blocks_go_again(&scene, 1);
    struct link_stats stats = stats_of(&scene);
    CHECK_EQUAL(stats.naks, 2);
    CHECK_EQUAL(stats.timeouts, 0);
    CHECK_EQUAL(stats.rto_ns, 20 * MS);
    CHECK_EQUAL(stats.blocks_repeated, 3);
    CHECK_EQUAL(stats.bytes_repeated, 76);
    scene.now += 20 * MS - 1;
    for (unsigned i = 0; i < 3; i++) {
        nak(&scene);
        CHECK_EQUAL(go(&scene), 0);
        CHECK_EQUAL(scene.link.naks_outstanding, 2 - i);
    }
    nak(&scene);
    CHECK_EQUAL(stats_of(&scene).naks, 6);
    CHECK_EQUAL(scene.link.naks_outstanding, 3);
    three_blocks_go_again(&scene, 1);
    scene.now += 20 * MS - 1;
    nak(&scene);
    CHECK_EQUAL(go(&scene), 0);
    scene.now++;
    nak(&scene);
    CHECK_EQUAL(scene.link.naks_outstanding, 6);
    three_blocks_go_again(&scene, 1);
    CHECK_EQUAL(stats_of(&scene).acks_duplicate, 0);
}

static void an_acknowledgement_behind_the_repeats_ends_their_naks(void) {
    struct scene scene;
    open_running(&scene, WINDOW);
    three_blocks_go(&scene);
    nak(&scene);
    three_blocks_go_again(&scene, 1);
    block_goes(&scene, 'd', 1);
    answer(&scene, scene.link.next - 1, 0); // the repeats, and no more
    CHECK_EQUAL(scene.link.naks_outstanding, 3);
    acknowledge_all(&scene);
    CHECK_EQUAL(scene.link.naks_outstanding, 0);
}

// Three blocks of 60 bytes that go again, after which the answers to their first transmissions come, late:
// the node may not have read the repeats yet. The next block goes, but not the one behind it.
static void repeats_are_acknowledged_too_soon(struct scene *scene) {
    open_running(scene, WINDOW);
    for (char tag = 'a'; tag <= 'c'; tag++)
        block_goes(scene, tag, 55);
    time_passes(scene, scene->now + 20 * MS);
    for (unsigned i = 0; i < 3; i++)
        CHECK_EQUAL(go(scene), i ? 60 : 61);
    control(scene, 'd', 55);
    control(scene, 'e', 55);
    for (unsigned i = 0; i < 2; i++) {
        answer(scene, scene->link.first + 1, 0);
        CHECK_EQUAL(go(scene), 0);
        CHECK_EQUAL(scene->link.late_bytes, i ? 121 : 61);
        CHECK_EQUAL(offer_of(scene, LINK_ALL).kind, LINK_CLASSES);
    }
    answer(scene, scene->link.first + 1, 0);
    CHECK_EQUAL(scene->link.late_bytes, 181);
    CHECK_EQUAL(go(scene), 60); // with nothing else in flight one block goes in any case
    CHECK_EQUAL(go(scene), 0);
}

static void what_a_node_may_not_have_read_takes_room(void) {
    struct scene scene;
    repeats_are_acknowledged_too_soon(&scene);
    for (unsigned i = 0; i < 3; i++) { // one for each repeat
        CHECK_EQUAL(go(&scene), 0);
        CHECK_EQUAL(scene.link.late_bytes, 181);
        nak(&scene);
    }
    CHECK_EQUAL(scene.link.late_bytes, 0);
    CHECK_EQUAL(go(&scene), 60);

    repeats_are_acknowledged_too_soon(&scene);
    answer(&scene, scene.link.next, 0); // the block behind the repeats: the node has read them
    CHECK_EQUAL(scene.link.late_bytes, 0);
    CHECK_EQUAL(go(&scene), 60);

    repeats_are_acknowledged_too_soon(&scene);
    time_passes(&scene, scene.now + SECOND / 2);
    CHECK_EQUAL(scene.link.late_bytes, 0);
    CHECK(go(&scene) > 0);
}

static void a_repeat_that_nothing_is_outstanding_of_has_been_read(void) {
    struct scene scene;
    open_running(&scene, WINDOW);
    for (char tag = 'a'; tag <= 'c'; tag++)
        block_goes(&scene, tag, 55);
    time_passes(&scene, scene.now + 20 * MS);
    for (unsigned i = 0; i < 3; i++) {
        CHECK(go(&scene) > 0);
        nak(&scene);
    }
    answer(&scene, scene.link.next - 1, 0);
    CHECK_EQUAL(scene.link.late_bytes, 0);
}

// 30: as many as two times the blocks that can be in flight.
static void no_more_naks_are_ignored_than_can_come(void) {
    struct scene scene;
    open_running(&scene, 4096);
    for (unsigned i = 0; i < 14; i++)
        block_goes(&scene, 'a', 1);
    static const uint64_t owed[] = {14, 28, 30, 30};
    for (unsigned i = 0; i < 4; i++) {
        scene.now += 250 * MS - 1; // long enough for every nak to be heard
        nak(&scene);
        CHECK_EQUAL(scene.link.naks_outstanding, owed[i]);
        for (unsigned k = 0; k < 14; k++)
            CHECK(go(&scene) > 0);
    }
}

// ----------------------------------------------------------------------------------------- acknowledgements

// The acknowledgement may come between the decision to repeat and the repeat.
static void what_is_acknowledged_is_not_repeated(void) {
    for (unsigned again = 0; again < 3; again++) {
        struct scene scene;
        open_running(&scene, WINDOW);
        three_blocks_go(&scene);
        time_passes(&scene, scene.now + 20 * MS);
        for (unsigned i = 0; i < again; i++)
            CHECK(go(&scene) > 0);
        acknowledge_all(&scene);
        CHECK_EQUAL(scene.link.in_flight_bytes, 0);
        CHECK_EQUAL(link_pending(&scene.link), 0);
        CHECK_EQUAL(go(&scene), 0);
        CHECK_EQUAL(deadline_of(&scene), NEVER);
        control(&scene, 'd', 4); // the flush that was meant for the repeat
        check_block(&scene, go(&scene), again ? 0 : 55, "dddd");
    }
}

static void a_part_may_be_acknowledged_while_it_is_repeated(void) {
    struct scene scene;
    open_running(&scene, WINDOW);
    three_blocks_go(&scene);
    time_passes(&scene, scene.now + 20 * MS);
    CHECK_EQUAL(go(&scene), 15 + 1);
    CHECK_EQUAL(go(&scene), 25);
    answer(&scene, scene.link.next - 1, 0);
    CHECK_EQUAL(scene.link.in_flight_bytes, 0);
    CHECK_EQUAL(link_pending(&scene.link), 1);
    check_block(&scene, go(&scene), 0, "cccccccccccccccccccccccccccccc");
    CHECK_EQUAL(scene.link.in_flight_bytes, 35);
}

static void what_was_never_sent_is_not_acknowledged(void) {
    struct scene scene;
    open_running(&scene, WINDOW);
    for (unsigned behind = 1; behind < 15; behind++) {
        block_goes(&scene, 'a', 1);
        for (unsigned ahead = 2; ahead < 16; ahead++)
            answer(&scene, scene.link.first + ahead, ahead % 3);
        CHECK_EQUAL(stats_of(&scene).acks_never_sent, 14 * behind);
        CHECK_EQUAL(link_pending(&scene.link), 1);
        acknowledge_all(&scene);
        CHECK_EQUAL(link_pending(&scene.link), 0);
    }
    CHECK_EQUAL(stats_of(&scene).naks, 0);
    CHECK_EQUAL(stats_of(&scene).acks_duplicate, 0);
}

// A response and the acknowledgement behind it name the same sequence: only a second empty block is a nak.
static void only_a_second_empty_block_is_a_nak(void) {
    struct scene scene;
    open_running(&scene, WINDOW);
    three_blocks_go(&scene);
    nak(&scene);
    CHECK_EQUAL(stats_of(&scene).naks, 1); // the acknowledgement before named it
    three_blocks_go_again(&scene, 1);
    uint64_t second = scene.link.first + 1;
    answer(&scene, second, 4);
    CHECK_EQUAL(link_pending(&scene.link), 2);
    answer(&scene, second, 0);
    answer(&scene, second, 4);
    CHECK_EQUAL(stats_of(&scene).naks, 1);
    answer(&scene, second, 0);
    CHECK_EQUAL(stats_of(&scene).naks, 2);
    acknowledge_all(&scene);
    CHECK_EQUAL(stats_of(&scene).acks_duplicate, 0);
    answer(&scene, scene.link.first, 4);
    CHECK_EQUAL(stats_of(&scene).acks_duplicate, 0);
    acknowledge_all(&scene); // with nothing in flight it refuses nothing
    CHECK_EQUAL(stats_of(&scene).acks_duplicate, 1);
    CHECK_EQUAL(stats_of(&scene).naks, 2);
}

// ---------------------------------------------------------------------------------------------------- loss

static void lose(struct scene *scene) {
    while (scene->link.state != LINK_LOST) {
        time_passes(scene, deadline_of(scene));
        while (go(scene))
            ;
    }
}

static void the_silence_counts_from_the_last_progress(void) {
    struct scene scene;
    open_running(&scene, WINDOW);
    scene.now += 7 * SECOND; // an idle link is never lost
    block_goes(&scene, 'a', 1);
    scene.now += 2 * MS;
    block_goes(&scene, 'b', 1);
    scene.now += 3 * MS;
    answer(&scene, scene.link.first + 1, 0);
    uint64_t progress_ns = scene.now;
    CHECK_EQUAL(link_unanswered_since(&scene.link), progress_ns);
    scene.now += MS;
    block_goes(&scene, 'c', 1); // makes no progress
    CHECK_EQUAL(link_unanswered_since(&scene.link), progress_ns);
    lose(&scene);
    CHECK_EQUAL(scene.now, progress_ns + SECOND);
    CHECK_EQUAL(scene.link.cause, LINK_CAUSE_SILENT); // the last that was heard was the progress
}

// Lets repeats go, each when it is due, until AT_NS.
static void nothing_comes_until(struct scene *scene, uint64_t at_ns) {
    while (deadline_of(scene) <= at_ns) {
        time_passes(scene, deadline_of(scene));
        while (go(scene) > 0)
            ;
    }
    time_passes(scene, at_ns);
}

// Repeats at 20, 60, 140, 265, 390, 515, 640, 765 ms …: of them those that no block came before for 250 ms.
static void a_silence_is_counted_at_a_repeat_when_a_quarter_of_a_second_is_over(void) {
    static const unsigned silent_from_ms[] = {265, 515, 765};
    struct scene scene;
    open_running(&scene, WINDOW);
    nothing_comes_until(&scene, scene.now + 7 * SECOND);
    CHECK_EQUAL(scene.link.silences, 0); // it owes nothing
    block_goes(&scene, 'a', 1);
    uint64_t sent_ns = scene.now;
    for (unsigned i = 0; i < 3; i++) {
        nothing_comes_until(&scene, sent_ns + silent_from_ms[i] * MS - 1);
        CHECK_EQUAL(scene.link.silences, i);
        nothing_comes_until(&scene, sent_ns + silent_from_ms[i] * MS);
        CHECK_EQUAL(scene.link.silences, i + 1);
    }
    lose(&scene);
    CHECK_EQUAL(scene.link.silences, 3);
}

static void whatever_comes_ends_the_silence(void) {
    for (int acknowledged = 0; acknowledged < 2; acknowledged++) {
        struct scene scene;
        open_running(&scene, WINDOW);
        block_goes(&scene, 'a', 1);
        block_goes(&scene, 'b', 1);
        uint64_t sent_ns = scene.now;
        nothing_comes_until(&scene, sent_ns + 200 * MS);
        if (acknowledged)
            answer(&scene, scene.link.first + 1, 0);
        else
            answer(&scene, scene.link.first, 4); // a response says nothing about what it has
        nothing_comes_until(&scene, sent_ns + 200 * MS + LINK_SILENCE_MS * MS - 1);
        CHECK_EQUAL(scene.link.silences, 0);
        nothing_comes_until(&scene, sent_ns + 600 * MS);
        CHECK_EQUAL(scene.link.silences, 1);
    }
}

static void before_contact_there_is_no_silence(void) {
    struct scene scene;
    open_link(&scene, WINDOW, SECOND);
    control(&scene, 'a', 1);
    CHECK(go(&scene) > 0);
    lose(&scene);
    CHECK_EQUAL(scene.link.silences, 0);
}

static void a_node_that_accepts_nothing_is_stuck(void) {
    struct scene scene;
    open_running(&scene, WINDOW);
    block_goes(&scene, 'a', 1);
    scene.now++;
    answer(&scene, scene.link.next + 3, 0);
    lose(&scene);
    CHECK_EQUAL(scene.link.cause, LINK_CAUSE_STUCK);
}

// What is lost stays as it is.
static void a_lost_link_does_nothing_more(void) {
    struct scene scene;
    open_running(&scene, 64); // what is queued stays there
    block_goes(&scene, 'a', 1);
    scene.now++;
    answer(&scene, scene.link.next + 3, 0);
    control(&scene, 'b', 59);
    control(&scene, 'c', 59);
    lose(&scene);
    struct link_stats before = stats_of(&scene);
    uint64_t since_ns = link_unanswered_since(&scene.link);
    CHECK_EQUAL(link_pending(&scene.link), 3);
    CHECK_EQUAL(try_send(&scene, LINK_CONTROL, 'd', 1, 0, 0), LINK_GONE);
    CHECK_EQUAL(try_motion(&scene, 'd', 1, 0, 0), LINK_GONE);
    CHECK_EQUAL(urgent(&scene, 'd', 1), LINK_GONE);
    CHECK_EQUAL(link_pending(&scene.link), 3);
    CHECK_EQUAL(deadline_of(&scene), NEVER);
    time_passes(&scene, scene.now + 9 * SECOND);
    CHECK_EQUAL(scene.link.cause, LINK_CAUSE_STUCK);
    CHECK_EQUAL(link_unanswered_since(&scene.link), since_ns);
    CHECK_EQUAL(answer(&scene, scene.link.first + 2, 3), 1); // a late response is one all the same
    CHECK_EQUAL(scene.response.sent_ns, 0);
    acknowledge_all(&scene);
    CHECK_EQUAL(link_unanswered_since(&scene.link), since_ns);
    CHECK_EQUAL(link_pending(&scene.link), 3);
    CHECK_EQUAL(offer_of(&scene, LINK_ALL).kind, LINK_CLASSES);
    CHECK_EQUAL(go(&scene), 0);
    struct link_stats after = stats_of(&scene);
    CHECK_EQUAL(after.timeouts, before.timeouts);
    CHECK_EQUAL(after.commands_dropped, 0);
    CHECK_EQUAL(after.blocks_received, before.blocks_received + 2);
}

// The moment that loses the link repeats nothing more.
static void the_end_is_no_timeout(void) {
    struct scene scene;
    open_running(&scene, WINDOW);
    block_goes(&scene, 'a', 1);
    uint64_t sent_ns = scene.now;
    time_passes(&scene, sent_ns + 20 * MS);
    scene.now = sent_ns + 955 * MS;
    CHECK(go(&scene) > 0);
    CHECK_EQUAL(deadline_of(&scene), sent_ns + 995 * MS);
    time_passes(&scene, sent_ns + SECOND);
    CHECK_EQUAL(scene.link.state, LINK_LOST);
    CHECK_EQUAL(stats_of(&scene).timeouts, 1);
}

// ------------------------------------------------------------------------------------------ a host that
// slept

// Whoever wakes a quarter of the time late and more has not asked meanwhile: three quarters begin then.
static void a_sleep_counts_as_a_quarter_at_most(void) {
    for (uint64_t late_ns = 250 * MS; late_ns <= 250 * MS + 1; late_ns++) {
        struct scene scene;
        open_running(&scene, WINDOW);
        block_goes(&scene, 'a', 1);
        uint64_t sent_ns = scene.now;
        time_passes(&scene, sent_ns + 20 * MS + late_ns);
        CHECK_EQUAL(stats_of(&scene).timeouts, 1);
        CHECK_EQUAL(deadline_of(&scene), late_ns > 250 * MS ? scene.now + 750 * MS : sent_ns + SECOND);
    }
    for (uint64_t late_ns = 250 * MS; late_ns <= 250 * MS + 1; late_ns++) { // with the repeat still to go
        struct scene scene;
        open_running(&scene, WINDOW);
        block_goes(&scene, 'a', 1);
        uint64_t sent_ns = scene.now;
        time_passes(&scene, sent_ns + 20 * MS);
        time_passes(&scene, sent_ns + SECOND + late_ns);
        CHECK_EQUAL(scene.link.state, late_ns > 250 * MS ? LINK_RUNNING : LINK_LOST);
        CHECK_EQUAL(deadline_of(&scene), late_ns > 250 * MS ? scene.now + 750 * MS : NEVER);
        CHECK_EQUAL(offer_of(&scene, LINK_ALL).kind, late_ns > 250 * MS ? LINK_CONTROL : LINK_CLASSES);
        CHECK_EQUAL(go(&scene), late_ns > 250 * MS ? 64 : 0);
    }
}

int main(void) {
    each_timeout_doubles_the_next_up_to_an_eighth_of_what_loses_the_link();
    the_last_repeat_ends_the_doublings_if_it_can_have_been_answered();
    no_sample_moves_the_mean_far();
    a_timeout_knows_the_deadline();
    whatever_waits_has_a_deadline();
    what_is_due_soon_is_repeated_twice();
    a_copy_that_does_not_fit_the_window_is_left_out();
    an_ignored_nak_shortens_the_timeout();
    round_trips_make_the_timeout();
    the_last_block_of_several_is_measured();
    a_timeout_flushes_the_node();
    repeats_stay_within_the_window();
    what_waits_behind_a_repeat_wakes_nobody();
    a_repeat_presses_where_motion_or_an_emergency_is_behind_it();
    naks_that_repeats_may_cause_are_ignored();
    an_acknowledgement_behind_the_repeats_ends_their_naks();
    what_a_node_may_not_have_read_takes_room();
    a_repeat_that_nothing_is_outstanding_of_has_been_read();
    no_more_naks_are_ignored_than_can_come();
    what_is_acknowledged_is_not_repeated();
    a_part_may_be_acknowledged_while_it_is_repeated();
    what_was_never_sent_is_not_acknowledged();
    only_a_second_empty_block_is_a_nak();
    the_silence_counts_from_the_last_progress();
    a_silence_is_counted_at_a_repeat_when_a_quarter_of_a_second_is_over();
    whatever_comes_ends_the_silence();
    before_contact_there_is_no_silence();
    a_node_that_accepts_nothing_is_stuck();
    a_lost_link_does_nothing_more();
    the_end_is_no_timeout();
    a_sleep_counts_as_a_quarter_at_most();
    return 0;
}
