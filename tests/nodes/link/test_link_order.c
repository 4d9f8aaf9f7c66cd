// SPDX-License-Identifier: Apache-2.0
// sources: firmware/wire/*.c nodes/link/core/link*.c nodes/link/core/queue.c
// What goes into the next block, in which order, and for what it waits.
#include "tests/nodes/link/link_scene.h"

enum { HZ = 512, TICK = 1953125, START = 100000 }; // a tick is a whole number of ns, and exact in binary

static const uint64_t margin_ns = 20 * MS + 1; // of a link that answers at once: round trip and timeout

static void clock(struct scene *scene, uint64_t at_ns) {
    CHECK_EQUAL(link_set_clock(&scene->link, HZ, at_ns, START), LINK_OK);
}

static void open_clocked(struct scene *scene, uint64_t window) {
    open_running(scene, window);
    clock(scene, scene->now);
}

// A clock by which motion of req_clock START should go at AT_NS.
static void motion_should_go_at(struct scene *scene, uint64_t at_ns) {
    clock(scene, at_ns + margin_ns);
}

static void check_waits_until(struct scene *scene, uint64_t at_ns, const char *content) {
    CHECK_EQUAL(deadline_of(scene), at_ns);
    CHECK_EQUAL(go(scene), 0);
    scene->now = at_ns - 1;
    CHECK_EQUAL(go(scene), 0);
    scene->now = at_ns;
    check_goes(scene, content);
}

// -------------------------------------------------------------------------------------------------- offers

static void each_class_should_go_in_its_time(void) {
    struct scene scene;
    open_running(&scene, WINDOW);
    CHECK_EQUAL(offer_of(&scene, LINK_ALL).kind, LINK_CLASSES);
    uint64_t queued_ns = scene.now;
    bulk(&scene, 'b', 1);
    scene.now += 3 * MS;
    CHECK_OFFER(&scene, LINK_BULK, queued_ns + 1000 * MS, 0);
    motion(&scene, 'm', 1, 0, START);
    CHECK_OFFER(&scene, LINK_MOTION, scene.now, 0); // nobody knows when: now
    motion_should_go_at(&scene, queued_ns + 10 * MS);
    CHECK_OFFER(&scene, LINK_MOTION, queued_ns + 10 * MS, 0);
    control(&scene, 'c', 1);
    CHECK_OFFER(&scene, LINK_CONTROL, queued_ns + 8 * MS, 0);
    scene.now = queued_ns + 10 * MS - 1;
    CHECK_OFFER(&scene, LINK_CONTROL, queued_ns + 8 * MS, 0);
    scene.now++;
    CHECK_OFFER(&scene, LINK_MOTION, queued_ns + 10 * MS, 1); // urgent: before what is due earlier
    check_goes(&scene, "mcb");
}

static void control_may_name_a_time_of_its_own_and_bulk_may_not(void) {
    struct scene scene;
    open_running(&scene, WINDOW);
    CHECK_EQUAL(try_send(&scene, LINK_CONTROL, 'c', 1, 0, START), LINK_OK);
    CHECK_OFFER(&scene, LINK_CONTROL, scene.now + 5 * MS, 0);
    motion_should_go_at(&scene, scene.now + 5 * MS + 1);
    CHECK_OFFER(&scene, LINK_CONTROL, scene.now + 5 * MS, 0);
    motion_should_go_at(&scene, scene.now + 5 * MS - 1);
    CHECK_OFFER(&scene, LINK_CONTROL, scene.now + 5 * MS - 1, 0);
    check_goes(&scene, "c");
    acknowledge_all(&scene);
    CHECK_EQUAL(try_send(&scene, LINK_BULK, 'b', 1, 0, START), LINK_OK);
    CHECK_OFFER(&scene, LINK_BULK, scene.now + 1000 * MS, 0);
}

static void equal_times_go_control_motion_bulk(void) {
    for (uint64_t later = 0; later < 2; later++) {
        struct scene scene;
        open_running(&scene, WINDOW);
        control(&scene, 'c', 1);
        motion(&scene, 'm', 1, 0, START);
        motion_should_go_at(&scene, scene.now + 5 * MS - later);
        check_goes(&scene, later ? "mc" : "cm");

        open_running(&scene, WINDOW);
        bulk(&scene, 'b', 1);
        motion(&scene, 'm', 1, 0, START);
        motion_should_go_at(&scene, scene.now + 1000 * MS + later);
        check_goes(&scene, later ? "bm" : "mb");

        open_running(&scene, WINDOW);
        bulk(&scene, 'b', 1);
        scene.now += 995 * MS + later;
        control(&scene, 'c', 1);
        check_goes(&scene, later ? "bc" : "cb");
    }
}

static void the_first_of_three_classes_goes_first(void) {
    struct scene scene;
    open_running(&scene, WINDOW);
    bulk(&scene, 'b', 2);
    scene.now += 2 * SECOND;
    control(&scene, 'c', 2);
    motion(&scene, 'm', 2, 0, START);
    motion_should_go_at(&scene, scene.now + MS);
    CHECK_OFFER(&scene, LINK_BULK, scene.now - SECOND, 0);
    check_goes(&scene, "bbmmcc");
    CHECK_EQUAL(link_pending(&scene.link), 3);
    acknowledge_all(&scene);
    CHECK_EQUAL(link_pending(&scene.link), 0);
}

static void urgent_goes_first_and_once(void) {
    struct scene scene;
    open_running(&scene, WINDOW);
    CHECK_EQUAL(urgent(&scene, 'u', 50), LINK_OK);
    bulk(&scene, 'b', 1);
    control(&scene, 'c', 50);
    control(&scene, 'd', 50);
    motion(&scene, 'm', 1, 0, START);
    motion_should_go_at(&scene, scene.now - 9 * MS);
    CHECK_OFFER(&scene, LINK_CONTROL, 0, 1);
    CHECK_EQUAL(offer_of(&scene, ONLY_BULK).kind, LINK_MOTION);
    check_goes(&scene, "uuuuuuuuuuuuuuuuuuuuuuuuuuuuuuuuuuuuuuuuuuuuuuuuuu"
                       "mb");
    CHECK_OFFER(&scene, LINK_CONTROL, 0, 1); // what is queued behind it in its class follows it
    check_goes(&scene, "cccccccccccccccccccccccccccccccccccccccccccccccccc");
    check_goes(&scene, "dddddddddddddddddddddddddddddddddddddddddddddddddd");
    acknowledge_all(&scene);
    control(&scene, 'e', 50);
    control(&scene, 'f', 50);
    for (int i = 0; i < 2; i++) { // and is over with the last of them
        CHECK_OFFER(&scene, LINK_CONTROL, scene.now + 5 * MS, 0);
        CHECK_EQUAL(go(&scene), 55);
    }
}

// What a clock holds back is no offer, however long it has waited.
static void only_what_may_go_is_offered(void) {
    struct scene scene;
    open_clocked(&scene, WINDOW);
    CHECK_EQUAL(try_send(&scene, LINK_CONTROL, 'c', 1, START + 10, 0), LINK_OK);
    CHECK_EQUAL(try_send(&scene, LINK_BULK, 'b', 1, START + 10, 0), LINK_OK);
    motion(&scene, 'm', 1, 0, START + 512);
    CHECK_OFFER(&scene, LINK_MOTION, scene.now + SECOND - margin_ns, 0);
    check_goes(&scene, "m");
    CHECK_EQUAL(offer_of(&scene, LINK_ALL).kind, LINK_CLASSES);
}

// ------------------------------------------------------------------------------------------------- budgets

static void only_allowed_classes_go(void) {
    static const char *const goes[] = {"", "m", "c", "cm", "b", "mb", "cb", "cmb"};
    for (unsigned allowed = 0; allowed <= 7; allowed++) {
        struct scene scene;
        open_running(&scene, WINDOW);
        bulk(&scene, 'b', 1);
        control(&scene, 'c', 1);
        motion(&scene, 'm', 1, 0, START);
        motion_should_go_at(&scene, scene.now + 10 * MS);
        CHECK_EQUAL(offer_of(&scene, allowed).kind == LINK_CLASSES, !allowed);
        if (allowed)
            check_block(&scene, go_of(&scene, allowed), 0, goes[allowed]);
        CHECK_EQUAL(go_of(&scene, allowed), 0);
    }
    CHECK_EQUAL(LINK_ALL, 7);
}

// Motion whose time has come goes without being allowed, and is waited for until then.
static void urgent_motion_needs_no_budget(void) {
    struct scene scene;
    open_running(&scene, WINDOW);
    motion(&scene, 'm', 1, 0, START);
    CHECK_EQUAL(go_of(&scene, 0), 0); // nobody knows when
    CHECK_EQUAL(offer_of(&scene, 0).kind, LINK_CLASSES);
    CHECK_EQUAL(link_deadline(&scene.link, scene.now, 0), NEVER);
    uint64_t due_ns = scene.now + 10 * MS;
    motion_should_go_at(&scene, due_ns);
    CHECK_EQUAL(link_deadline(&scene.link, scene.now, 0), due_ns);
    scene.now = due_ns - 1;
    CHECK_EQUAL(go_of(&scene, ONLY_CONTROL | ONLY_BULK), 0);
    CHECK_EQUAL(link_deadline(&scene.link, scene.now, 0), due_ns);
    scene.now = due_ns;
    CHECK_EQUAL(offer_of(&scene, 0).urgent, 1);
    check_block(&scene, go_of(&scene, 0), 0, "m");
}

// Of what may not go and what may go later, the earliest wakes.
static void a_gate_and_motion_without_budget_both_wake(void) {
    for (unsigned ticks = 100; ticks <= 500; ticks += 400) {
        struct scene scene;
        open_clocked(&scene, WINDOW);
        uint64_t due_ns = scene.now + 500 * MS - margin_ns, gate_ns = scene.now + ticks * TICK + 2 * MS;
        motion(&scene, 'm', 1, 0, START + 256);
        CHECK_EQUAL(try_send(&scene, LINK_CONTROL, 'c', 1, START + ticks, 0), LINK_OK);
        CHECK_EQUAL(link_deadline(&scene.link, scene.now, 0), due_ns); // nothing else matters then
        CHECK_EQUAL(link_deadline(&scene.link, scene.now, ONLY_CONTROL), ticks == 100 ? gate_ns : due_ns);
    }
}

// ------------------------------------------------------------------------------------------------- packing

static void blocks_are_filled_to_the_last_byte(void) {
    struct scene scene;
    open_running(&scene, WINDOW);
    motion(&scene, 'm', 30, 0, 0);
    motion(&scene, 'n', 20, 0, 0);
    motion(&scene, 'o', 10, 0, 0); // one too many
    motion(&scene, 'p', 1, 0, 0);  // does not overtake
    control(&scene, 'c', 9);
    CHECK_EQUAL(stats_of(&scene).commands_sent, 1);
    check_goes(&scene, "mmmmmmmmmmmmmmmmmmmmmmmmmmmmmmnnnnnnnnnnnnnnnnnnnnccccccccc");
    check_goes(&scene, "oooooooooop");
    CHECK_EQUAL(stats_of(&scene).commands_sent, 6);
    CHECK_EQUAL(scene.link.motion_content, 61);
    CHECK_EQUAL(link_pending(&scene.link), 5);
    answer(&scene, scene.link.first + 1, 0);
    CHECK_EQUAL(link_pending(&scene.link), 2);
}

// A block of motion that could be filled waits for what fits into it: for the last of it.
static void motion_waits_for_its_fill(void) {
    static const struct {
        size_t second, third;
        unsigned ticks;
        const char *content;
    } cases[] = {
        {10, 10, 20, "aaaaaaaaaabbbbbbbbbbcccccccccc"},
        {40, 9, 20, "aaaaaaaaaabbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbccccccccc"},
        {40, 10, 10, "aaaaaaaaaabbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbb"},
        {49, 1, 10, "aaaaaaaaaabbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbb"},
    };
    for (size_t i = 0; i < sizeof cases / sizeof *cases; i++) {
        struct scene scene;
        open_clocked(&scene, WINDOW);
        motion(&scene, 'a', 10, START, START + 1024);
        scene.now += 2 * MS;
        motion(&scene, 'b', cases[i].second, START + 10, START + 1025);
        motion(&scene, 'c', cases[i].third, START + 20, START + 1026);
        motion(&scene, 'd', 59, START + 30, START + 1027);
        check_waits_until(&scene, scene.now + cases[i].ticks * TICK, cases[i].content);
    }
}

// An earlier gate behind a later one does not count, and the last record is the last.
static void motion_waits_for_the_latest_of_its_fill(void) {
    struct scene scene;
    open_clocked(&scene, WINDOW);
    motion(&scene, 'a', 1, 0, START + 1024);
    motion(&scene, 'b', 1, START + 20, START + 1024);
    motion(&scene, 'c', 1, START + 10, START + 1024);
    check_waits_until(&scene, scene.now + 20 * TICK + 2 * MS, "abc");
}

// Behind the last record the ring may hold one of an earlier turn.
static void what_is_behind_the_last_record_is_not_looked_at(void) {
    struct scene scene;
    open_clocked(&scene, WINDOW);
    motion(&scene, 'a', 1, 0, START + 1024);
    uint8_t *behind = scene_memories[LINK_MOTION] + scene.link.queues[LINK_MOTION].tail;
    batch_write(behind, START + 10, START + 1024, (const uint8_t *)"z", 1);
    check_goes(&scene, "a");
    acknowledge_all(&scene);
    motion(&scene, 'b', 1, 0, START + 1024);
    motion(&scene, 'c', 1, START + 10, START + 1024);
    behind = scene_memories[LINK_MOTION] + scene.link.queues[LINK_MOTION].tail;
    batch_write(behind, START + 20, START + 1024, (const uint8_t *)"z", 1);
    check_waits_until(&scene, scene.now + 10 * TICK + 2 * MS, "bc");
}

// It waits no longer than until 100 ms before its first command is due.
static void motion_that_presses_does_not_wait_for_its_fill(void) {
    struct scene scene;
    open_clocked(&scene, WINDOW);
    motion(&scene, 'a', 1, 0, START + 128); // 250 ms
    motion(&scene, 'b', 1, START + 104, START + 512);
    check_waits_until(&scene, scene.now + 150 * MS, "a");
    acknowledge_all(&scene);
    clock(&scene, scene.now);
    motion(&scene, 'c', 1, 0, 0); // no time of its own
    check_waits_until(&scene, scene.now - 150 * MS + 104 * TICK + 2 * MS + 150 * MS, "bc");
}

static void motion_without_a_time_does_not_wait_for_its_fill(void) {
    struct scene scene;
    open_clocked(&scene, WINDOW);
    motion(&scene, 'a', 1, 0, 0);
    motion(&scene, 'b', 1, START + 10, START + 512);
    check_goes(&scene, "a");
}

// Nor for what is never to come.
static void motion_does_not_wait_for_what_never_goes(void) {
    struct scene scene;
    open_running(&scene, WINDOW);
    motion(&scene, 'a', 1, 0, START + 1000);
    motion(&scene, 'b', 1, START + 10000000000, START + 1000);
    check_goes(&scene, "a"); // there is no clock
    acknowledge_all(&scene);
    CHECK_EQUAL(link_set_clock(&scene.link, 1, scene.now, START), LINK_OK);
    CHECK_EQUAL(urgent(&scene, 'u', 1), LINK_OK);
    check_goes(&scene, "u");
    acknowledge_all(&scene);
    motion(&scene, 'c', 1, 0, START + 1000);
    motion(&scene, 'd', 1, START + 10000000000, START + 1000);
    check_goes(&scene, "c");
}

// What goes with motion does not wait for its fill; what does not fit beside it does.
static void only_motion_alone_waits(void) {
    struct scene scene;
    open_clocked(&scene, WINDOW);
    motion(&scene, 'm', 3, 0, START + 1024);
    motion(&scene, 'n', 3, START + 10, START + 1024);
    CHECK_EQUAL(go(&scene), 0);
    control(&scene, 'c', 3);
    check_goes(&scene, "cccmmm");

    open_clocked(&scene, WINDOW);
    motion(&scene, 'm', 30, 0, START + 256); // to go at 480 ms
    motion(&scene, 'n', 3, START + 10, START + 1024);
    bulk(&scene, 'b', 50);
    check_waits_until(&scene, scene.now + 10 * TICK + 2 * MS, "mmmmmmmmmmmmmmmmmmmmmmmmmmmmmmnnn");
    check_goes(&scene, "bbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbb");
}

// A gate of another class and the fill of motion: the earlier wakes.
static void a_gate_may_end_the_wait_for_the_fill(void) {
    for (unsigned ticks = 5; ticks <= 25; ticks += 20) {
        struct scene scene;
        open_clocked(&scene, WINDOW);
        motion(&scene, 'm', 1, 0, START + 1024);
        motion(&scene, 'n', 1, START + 15, START + 1024);
        CHECK_EQUAL(try_send(&scene, LINK_CONTROL, 'c', 1, START + ticks, 0), LINK_OK);
        check_waits_until(&scene, scene.now + (ticks < 15 ? 5u : 15u) * TICK + 2 * MS,
                          ticks < 15 ? "cm" : "mn");
    }
}

// -------------------------------------------------------------------------------------------------- window

static void fifteen_blocks_fly_at_most(void) {
    struct scene scene;
    open_running(&scene, 4096);
    for (unsigned i = 0; i < 15; i++) {
        control(&scene, 'c', 1);
        check_goes(&scene, "c");
    }
    control(&scene, 'd', 1);
    CHECK_EQUAL(offer_of(&scene, LINK_ALL).kind, LINK_CLASSES);
    CHECK_EQUAL(go(&scene), 0);
    CHECK_EQUAL(deadline_of(&scene), scene.now + 20 * MS);
    answer(&scene, scene.link.first + 1, 0);
    check_goes(&scene, "d");
    acknowledge_all(&scene);
    CHECK_EQUAL(link_pending(&scene.link), 0);
}

static void the_window_is_filled_to_the_last_byte(void) {
    for (size_t size = 1; size <= 59; size++)
        for (size_t short_of = 0; short_of < 2; short_of++) {
            struct scene scene;
            open_running(&scene, 64 + 5 + size - short_of);
            control(&scene, 'c', 59);
            CHECK_EQUAL(go(&scene), 64);
            control(&scene, 'd', size);
            CHECK_EQUAL(offer_of(&scene, LINK_ALL).kind, short_of ? LINK_CLASSES : LINK_CONTROL);
            CHECK_EQUAL(go(&scene), short_of ? 0 : size + 5);
            CHECK_EQUAL(deadline_of(&scene), scene.now + 20 * MS);
        }
}

// A fill that is complete just now does not wake while the window is full.
static void a_full_window_wakes_nobody(void) {
    struct scene scene;
    open_link(&scene, 64, SECOND);
    run_up(&scene, 100 * MS); // a timeout of 125 ms
    clock(&scene, scene.now);
    control(&scene, 'c', 59);
    CHECK_EQUAL(go(&scene), 64);
    uint64_t sent_ns = scene.now;
    motion(&scene, 'm', 1, 0, START + 1024);
    motion(&scene, 'n', 1, START + 10, START + 1024);
    uint64_t full_ns = sent_ns + 10 * TICK + 2 * MS;
    CHECK_EQUAL(deadline_of(&scene), full_ns);
    scene.now = full_ns;
    CHECK_EQUAL(deadline_of(&scene), sent_ns + 125 * MS);
    CHECK_EQUAL(go(&scene), 0);
    motion(&scene, 'o', 50, START + 512, START + 1024);
    CHECK_EQUAL(deadline_of(&scene), sent_ns + 125 * MS); // before the gate
}

// Nor does motion that begins to press just now.
static void a_full_window_wakes_nobody_for_what_presses(void) {
    struct scene scene;
    open_link(&scene, 64, SECOND);
    run_up(&scene, 100 * MS);
    clock(&scene, scene.now);
    control(&scene, 'c', 59);
    CHECK_EQUAL(go(&scene), 64);
    uint64_t sent_ns = scene.now;
    motion(&scene, 'm', 1, 0, START + 104); // 203.125 ms
    motion(&scene, 'n', 1, START + 112, START + 512);
    CHECK_EQUAL(deadline_of(&scene), sent_ns + 103125000);
    scene.now = sent_ns + 103125000;
    CHECK_EQUAL(deadline_of(&scene), sent_ns + 125 * MS);
}

static void bulk_leaves_a_block_of_the_window(void) {
    for (uint64_t window = 191; window <= 192; window++) {
        struct scene scene;
        open_running(&scene, window);
        bulk(&scene, 'b', 59);
        bulk(&scene, 'b', 59);
        bulk(&scene, 'b', 1);
        CHECK_EQUAL(go(&scene), 64);
        CHECK_EQUAL(go(&scene), window == 192 ? 64 : 0);
        CHECK_EQUAL(go(&scene), 0);
        CHECK_EQUAL(offer_of(&scene, LINK_ALL).kind, LINK_CLASSES);
        control(&scene, 'c', 59); // which others may use
        CHECK_OFFER(&scene, LINK_CONTROL, scene.now + 5 * MS, 0);
        CHECK_EQUAL(go(&scene), 64);
    }
}

// Bulk that is due first and does not fit lets the others pass, and does not fill their blocks.
static void bulk_without_room_is_passed(void) {
    struct scene scene;
    open_running(&scene, 192);
    bulk(&scene, 'b', 59);
    bulk(&scene, 'b', 59);
    bulk(&scene, 'b', 9);
    scene.now += 2 * SECOND;
    CHECK_EQUAL(go(&scene), 64);
    CHECK_EQUAL(go(&scene), 64);
    CHECK_EQUAL(go(&scene), 0);
    motion(&scene, 'm', 3, 0, 0);
    control(&scene, 'c', 3);
    CHECK_OFFER(&scene, LINK_MOTION, scene.now, 0);
    check_goes(&scene, "mmmccc");
    CHECK_EQUAL(go(&scene), 0);
    CHECK_EQUAL(deadline_of(&scene), scene.now + 20 * MS);
}

int main(void) {
    each_class_should_go_in_its_time();
    control_may_name_a_time_of_its_own_and_bulk_may_not();
    equal_times_go_control_motion_bulk();
    the_first_of_three_classes_goes_first();
    urgent_goes_first_and_once();
    only_what_may_go_is_offered();
    only_allowed_classes_go();
    urgent_motion_needs_no_budget();
    a_gate_and_motion_without_budget_both_wake();
    blocks_are_filled_to_the_last_byte();
    motion_waits_for_its_fill();
    motion_waits_for_the_latest_of_its_fill();
    what_is_behind_the_last_record_is_not_looked_at();
    motion_that_presses_does_not_wait_for_its_fill();
    motion_without_a_time_does_not_wait_for_its_fill();
    motion_does_not_wait_for_what_never_goes();
    only_motion_alone_waits();
    a_gate_may_end_the_wait_for_the_fill();
    fifteen_blocks_fly_at_most();
    the_window_is_filled_to_the_last_byte();
    a_full_window_wakes_nobody();
    a_full_window_wakes_nobody_for_what_presses();
    bulk_leaves_a_block_of_the_window();
    bulk_without_room_is_passed();
    return 0;
}
