// SPDX-License-Identifier: Apache-2.0
// sources: firmware/wire/*.c nodes/link/core/link*.c nodes/link/core/queue.c
// A node's clock: what it says of host time, and when commands may and should go by it.
#include <math.h>

#include "nodes/link/core/link_core.h"
#include "tests/nodes/link/link_scene.h"

enum { HZ = 512, TICK = 1953125, START = 100000 }; // a tick is a whole number of ns, and exact in binary

static const uint64_t reach = 1ULL << 30;

static void clock(struct scene *scene, double freq_hz, uint64_t at_ns, uint64_t at_ticks) {
    CHECK_EQUAL(link_set_clock(&scene->link, freq_hz, at_ns, at_ticks), LINK_OK);
}

static void only_a_clock_is_accepted(void) {
    struct scene scene;
    open_link(&scene, WINDOW, SECOND);
    clock(&scene, HZ, 5, 6);
    const double bad[] = {0, -0.0, -1, -0.5, NAN, INFINITY, -INFINITY};
    for (size_t i = 0; i < sizeof bad / sizeof *bad; i++)
        CHECK_EQUAL(link_set_clock(&scene.link, bad[i], 1, 1), LINK_INVALID);
    CHECK_EQUAL(link_clock_to_ns(&scene.link, 7), 5 + TICK); // what was set stays
    clock(&scene, 0.5, 0, 0);
    CHECK_EQUAL(link_clock_to_ns(&scene.link, 1), 2 * SECOND);
}

static void ticks_are_moments(void) {
    const struct {
        double freq_hz;
        uint64_t at_ns, at_ticks, ticks, ns;
    } cases[] = {
        {HZ, 5 * SECOND, 1000, 1000, 5 * SECOND},
        {HZ, 5 * SECOND, 1000, 1001, 5 * SECOND + TICK},
        {HZ, 5 * SECOND, 1000, 999, 5 * SECOND - TICK},
        {HZ, 5 * SECOND, 1000, 1000 + HZ, 6 * SECOND},
        {HZ, 5 * SECOND, 1000, 1000 - HZ, 4 * SECOND},
        // Rounded up: never a moment too early.
        {3, 5 * SECOND, 1000, 1001, 5 * SECOND + 333333334},
        {3, 5 * SECOND, 1000, 999, 5 * SECOND - 333333333},
        // Before the host's time there is nothing, and far enough ahead is never.
        {1, 5 * SECOND, 10, 6, SECOND},
        {1, 5 * SECOND, 10, 5, 0},
        {1, 5 * SECOND, 10, 4, 0},
        {1, 5, 10, 10 + 8192000000, 5 + 8192000000 * SECOND},
        {1, 5, 10, 10 + 9000000000, NEVER},
        {1e-9, 5, 0, UINT64_MAX, NEVER},
    };
    struct scene scene;
    open_link(&scene, WINDOW, SECOND);
    for (size_t i = 0; i < sizeof cases / sizeof *cases; i++) {
        clock(&scene, cases[i].freq_hz, cases[i].at_ns, cases[i].at_ticks);
        CHECK_EQUAL(link_clock_to_ns(&scene.link, cases[i].ticks), cases[i].ns);
    }
}

// A round trip, and then the timeout, are kept for a repeat; 100 ms at most.
static void motion_should_go_before_it_is_due(void) {
    struct scene scene;
    open_link(&scene, WINDOW, SECOND);
    CHECK_EQUAL(link_motion_due(&scene.link, START), 0);
    clock(&scene, HZ, 9 * SECOND, START);
    CHECK_EQUAL(link_motion_due(&scene.link, 0), 0);
    CHECK_EQUAL(link_motion_due(&scene.link, START), 9 * SECOND - 100 * MS);
    clock(&scene, HZ, 100 * MS + 2, START);
    CHECK_EQUAL(link_motion_due(&scene.link, START), 2);
    clock(&scene, HZ, 100 * MS, START);
    CHECK_EQUAL(link_motion_due(&scene.link, START), 1);
    clock(&scene, HZ, 1, START);
    CHECK_EQUAL(link_motion_due(&scene.link, START), 1);
    clock(&scene, 0.5, 9 * SECOND, START);
    CHECK_EQUAL(link_motion_due(&scene.link, START), 9 * SECOND - 100 * MS);
    run_up(&scene, 10 * MS); // a timeout of 25 ms
    CHECK_EQUAL(link_motion_due(&scene.link, START), 9 * SECOND - 35 * MS);
    open_link(&scene, WINDOW, SECOND);
    run_up(&scene, 60 * MS);
    clock(&scene, HZ, 9 * SECOND, START);
    CHECK_EQUAL(link_motion_due(&scene.link, START), 9 * SECOND - 100 * MS);
}

// Nothing goes before AT_NS, and nothing keeps it then.
static void check_waits_until(struct scene *scene, uint64_t at_ns, const char *content) {
    CHECK_EQUAL(deadline_of(scene), at_ns);
    CHECK_EQUAL(offer_of(scene, LINK_ALL).kind, LINK_CLASSES);
    CHECK_EQUAL(go(scene), 0);
    scene->now = at_ns - 1;
    CHECK_EQUAL(deadline_of(scene), at_ns);
    CHECK_EQUAL(offer_of(scene, LINK_ALL).kind, LINK_CLASSES);
    CHECK_EQUAL(go(scene), 0);
    scene->now = at_ns;
    CHECK(offer_of(scene, LINK_ALL).kind != LINK_CLASSES);
    check_goes(scene, content);
}

static void a_command_waits_for_its_min_clock(void) {
    for (int kind = 0; kind < LINK_CLASSES; kind++) {
        struct scene scene;
        open_running(&scene, WINDOW);
        clock(&scene, HZ, scene.now, START);
        if (kind == LINK_MOTION)
            motion(&scene, 'x', 2, START + 10, 0);
        else
            CHECK_EQUAL(try_send(&scene, (enum link_class)kind, 'x', 2, START + 10, 0), LINK_OK);
        check_waits_until(&scene, scene.now + 10 * TICK + 2 * MS, "xx");
    }
}

// Classes wait each for its own: what comes first wakes.
static void the_earliest_of_all_classes_wakes(void) {
    for (unsigned turn = 0; turn < 3; turn++) {
        struct scene scene;
        open_running(&scene, WINDOW);
        clock(&scene, HZ, scene.now, START);
        motion(&scene, 'm', 1, START + 10 + 10 * (turn % 3), 0);
        CHECK_EQUAL(try_send(&scene, LINK_CONTROL, 'c', 1, START + 10 + 10 * ((turn + 1) % 3), 0), LINK_OK);
        CHECK_EQUAL(try_send(&scene, LINK_BULK, 'b', 1, START + 10 + 10 * ((turn + 2) % 3), 0), LINK_OK);
        const char *firsts[] = {"m", "b", "c"};
        check_waits_until(&scene, scene.now + 10 * TICK + 2 * MS, firsts[turn]);
    }
}

static void a_clock_of_32_bits_has_to_reach(void) {
    struct scene scene;
    open_running(&scene, WINDOW);
    clock(&scene, HZ, scene.now, START);
    motion(&scene, 'm', 2, 0, START + reach);
    check_goes(&scene, "mm");
    acknowledge_all(&scene);
    motion(&scene, 'n', 2, 0, START + reach + 3);
    check_waits_until(&scene, scene.now + 3 * TICK, "nn");
    acknowledge_all(&scene);
    clock(&scene, HZ, scene.now, START);
    motion(&scene, 'o', 2, START + 9, START + reach + 3); // the later of both
    check_waits_until(&scene, scene.now + 9 * TICK + 2 * MS, "oo");
    acknowledge_all(&scene);
    clock(&scene, HZ, scene.now, START);
    motion(&scene, 'p', 2, START + 3, START + reach + 9);
    check_waits_until(&scene, scene.now + 9 * TICK, "pp");
}

// In steps of a quarter of the time ahead, never later than that before it is due.
static void motion_does_not_go_too_far_ahead(void) {
    static const struct {
        uint64_t due, at_ns; // ticks after START, which is at one second
    } cases[] = {{3 * HZ, 2000 * MS}, {3 * HZ + 1, 2500 * MS}, {7 * HZ / 2, 2500 * MS}, {4 * HZ, 3000 * MS}};
    struct scene scene;
    for (size_t i = 0; i < sizeof cases / sizeof *cases; i++) {
        open_running(&scene, WINDOW);
        scene.link.settings.ahead_ns = 2 * SECOND;
        clock(&scene, HZ, scene.now, START);
        motion(&scene, 'm', 2, 0, START + cases[i].due);
        check_waits_until(&scene, cases[i].at_ns, "mm");
    }
    open_running(&scene, WINDOW);
    scene.link.settings.ahead_ns = 2 * SECOND;
    clock(&scene, HZ, scene.now, START);
    motion(&scene, 'n', 2, 0, START + 2 * HZ); // near enough
    check_goes(&scene, "nn");
    motion(&scene, 'o', 2, 0, 0); // at any time
    check_goes(&scene, "oo");
    acknowledge_all(&scene);
    motion(&scene, 'p', 2, START + 3 * HZ, START + 3 * HZ); // there is no room before
    check_waits_until(&scene, 4 * SECOND + 2 * MS, "pp");
    acknowledge_all(&scene);
    CHECK_EQUAL(try_send(&scene, LINK_CONTROL, 'c', 2, 0, START + 99 * HZ), LINK_OK); // as far as it likes
    check_goes(&scene, "cc");
    acknowledge_all(&scene);
    motion(&scene, 'q', 2, 0, UINT64_MAX);
    CHECK_EQUAL(go(&scene), 0);
    CHECK(deadline_of(&scene) > UINT64_MAX / 2);
}

// What is due within reach is not held back, even by a clock that has not begun.
static void a_clock_that_has_not_begun_holds_nothing_back(void) {
    struct scene scene;
    open_running(&scene, WINDOW);
    clock(&scene, HZ, scene.now + SECOND, 0);
    motion(&scene, 'm', 2, 0, 5);
    check_goes(&scene, "mm");
}

static void without_a_clock_only_what_needs_one_waits(void) {
    struct scene scene;
    open_running(&scene, WINDOW);
    motion(&scene, 'm', 2, 0, 1ULL << 40); // due, but nobody knows when
    check_goes(&scene, "mm");
    acknowledge_all(&scene);
    CHECK_EQUAL(try_send(&scene, LINK_CONTROL, 'c', 2, 1, 0), LINK_OK);
    motion(&scene, 'n', 2, 1, 1);
    CHECK_EQUAL(go(&scene), 0);
    CHECK_EQUAL(deadline_of(&scene), NEVER);
    clock(&scene, 0.5, scene.now, 1);
    check_waits_until(&scene, scene.now + 2 * MS, "nncc");
}

static void the_end_of_time_is_not_passed(void) {
    struct scene scene;
    open_running(&scene, WINDOW);
    CHECK_EQUAL(try_send(&scene, LINK_CONTROL, 'c', 2, START, 0), LINK_OK);
    clock(&scene, HZ, NEVER - 2 * MS - 1, START);
    CHECK_EQUAL(deadline_of(&scene), NEVER - 1);
    clock(&scene, HZ, NEVER - 2 * MS, START);
    CHECK_EQUAL(deadline_of(&scene), NEVER - 2 * MS);
    clock(&scene, HZ, NEVER - 2 * MS + 5, START);
    CHECK_EQUAL(deadline_of(&scene), NEVER - 2 * MS + 5);
}

// The host's time may begin with a link: nothing waits for its first nanosecond.
static void at_the_beginning_of_time_all_goes(void) {
    struct scene scene;
    open_link(&scene, WINDOW, 0);
    run_up(&scene, 0);
    CHECK_EQUAL(stats_of(&scene).srtt_ns, 1);
    CHECK_EQUAL(stats_of(&scene).blocks_repeated, 0);
    control(&scene, 'c', 1);
    check_goes(&scene, "c");
    acknowledge_all(&scene);
    motion(&scene, 'm', 1, 0, 7);
    check_goes(&scene, "m");
    acknowledge_all(&scene);
    clock(&scene, HZ, 0, START);
    CHECK_EQUAL(try_send(&scene, LINK_CONTROL, 'd', 1, START - 3, START - 2), LINK_OK);
    check_goes(&scene, "d");
    acknowledge_all(&scene);
    motion(&scene, 'n', 1, 0, START + 5);
    check_goes(&scene, "n");
    acknowledge_all(&scene);
    motion(&scene, 'o', 1, 0, START + 10); // due within what blocks wait for their fill
    motion(&scene, 'p', 1, START + 20, START + 30);
    check_goes(&scene, "o");
    CHECK_EQUAL(link_unanswered_since(&scene.link), 1);
    scene.now = 20 * MS;
    CHECK_EQUAL(link_deadline(&scene.link, scene.now, LINK_ALL), scene.now + 1);
    scene.now++;
    link_handle_timer(&scene.link, scene.now);
    check_block(&scene, go(&scene), 58, "o");
    CHECK_EQUAL(stats_of(&scene).blocks_repeated, 1);
}

int main(void) {
    only_a_clock_is_accepted();
    ticks_are_moments();
    motion_should_go_before_it_is_due();
    a_command_waits_for_its_min_clock();
    the_earliest_of_all_classes_wakes();
    a_clock_of_32_bits_has_to_reach();
    motion_does_not_go_too_far_ahead();
    a_clock_that_has_not_begun_holds_nothing_back();
    without_a_clock_only_what_needs_one_waits();
    the_end_of_time_is_not_passed();
    at_the_beginning_of_time_all_goes();
    return 0;
}
