// SPDX-License-Identifier: Apache-2.0
// sources: firmware/wire/*.c nodes/link/core/*.c nodes/link/io/*.c nodes/support/can_bits.c
// Responses that may wait: the driver is notified of them when they have waited, with whatever else comes, or
// not at all, where the program takes them before.
#include "tests/nodes/link/bus_scene.h"

enum { OTHER_NODE = NODE + 1 };

static const uint8_t short_id[] = {0x12}, long_id[] = {0x81, 0x12}, longer_id[] = {0x81, 0x13};

static void begin(struct scene *scene) {
    static const struct io_settings unknown_speed = {0};
    open(scene, IO_CAN_STREAM, NODE, &unknown_speed);
}

static void open_other(struct scene *scene, uint32_t *link) {
    CHECK_EQUAL(io_open_link(scene->bus, OTHER_NODE, &usual, link), IO_OK);
}

static void other_says(struct scene *scene, const uint8_t *content, size_t size) {
    uint8_t block[WIRE_BLOCK_MAX];
    memcpy(block + WIRE_HEADER, content, size);
    size_t length = wire_block_finish(block, size, 0);
    frame_comes(scene, id_of(OTHER_NODE) + 1u, block, length);
}

static void let_wait(struct scene *scene, const uint8_t *id, size_t size, uint64_t wait_ns) {
    CHECK_EQUAL(io_let_wait(scene->bus, scene->link, id, size, wait_ns, 0), IO_OK);
}

static void let_wait_together(struct scene *scene, uint32_t together) {
    CHECK_EQUAL(io_let_wait(scene->bus, scene->link, short_id, 1, 100 * MS, together), IO_OK);
}

static void check_waits(struct scene *scene, int notices, uint64_t left_ns) {
    CHECK_EQUAL(scene->notices, notices);
    CHECK_EQUAL(io_waits(scene->bus), 1);
    CHECK_EQUAL(io_deadline(scene->bus, scene->now_ns) - scene->now_ns, left_ns);
}

static void check_told(struct scene *scene, int notices) {
    CHECK_EQUAL(scene->notices, notices);
    CHECK_EQUAL(io_waits(scene->bus), 0);
    CHECK_EQUAL(io_deadline(scene->bus, scene->now_ns), UINT64_MAX);
}

static size_t take(struct scene *scene) {
    struct io_event events[16];
    return io_take(scene->bus, events, 16);
}

static void time_passes(struct scene *scene, uint64_t ns) {
    scene->now_ns += ns;
    io_handle_time(scene->bus, scene->now_ns);
}

static void it_is_told_when_it_has_waited(void) {
    struct scene scene;
    begin(&scene);
    let_wait(&scene, short_id, 1, 100 * MS);
    answer(&scene, short_id, 1);
    check_waits(&scene, 0, 100 * MS);
    time_passes(&scene, 30 * MS);
    answer(&scene, short_id, 1); // the first that came counts
    check_waits(&scene, 0, 70 * MS);
    time_passes(&scene, 70 * MS - 1);
    check_waits(&scene, 0, 1);
    time_passes(&scene, 1);
    check_told(&scene, 1);
    answer(&scene, short_id, 1); // it goes with them
    check_told(&scene, 1);
    CHECK_EQUAL(take(&scene), 3);
    check_told(&scene, 1);
    answer(&scene, short_id, 1);
    check_waits(&scene, 1, 100 * MS);
    io_free(scene.bus);
}

static void who_takes_it_before_is_not_told(void) {
    struct scene scene;
    begin(&scene);
    let_wait(&scene, short_id, 1, 100 * MS);
    answer(&scene, short_id, 1);
    time_passes(&scene, 50 * MS);
    CHECK_EQUAL(take(&scene), 1);
    check_told(&scene, 0);
    time_passes(&scene, 50 * MS);
    check_told(&scene, 0);
    io_free(scene.bus);
}

// A response of another kind or another node, a frame of none, a state of a link.
static void what_may_not_wait_is_told_at_once_and_takes_it_along(void) {
    for (int what = 0; what < 4; what++) {
        struct scene scene;
        uint32_t other;
        begin(&scene);
        open_other(&scene, &other);
        let_wait(&scene, long_id, 2, 100 * MS);
        answer(&scene, long_id, 2);
        time_passes(&scene, 99 * MS);
        if (what == 0)
            answer(&scene, longer_id, 2);
        else if (what == 1)
            other_says(&scene, long_id, 2);
        else if (what == 2)
            frame_comes(&scene, TO_PYTHON_ID, long_id, 2);
        else
            CHECK_EQUAL(io_watch_drained(scene.bus, scene.link), IO_OK);
        check_told(&scene, 1);
        CHECK_EQUAL(take(&scene), 2);
        io_free(scene.bus);
    }
}

static void all_that_come_together_are_told_at_once(void) {
    struct scene scene;
    begin(&scene);
    let_wait_together(&scene, 3);
    for (int round = 1; round <= 3; round++) {
        answer(&scene, short_id, 1);
        answer(&scene, short_id, 1);
        check_waits(&scene, round - 1, 100 * MS);
        answer(&scene, short_id, 1);
        check_told(&scene, round);
        CHECK_EQUAL(take(&scene), 3);
    }
    io_free(scene.bus);
}

static void what_was_taken_does_not_count_among_those_that_wait(void) {
    struct scene scene;
    begin(&scene);
    let_wait_together(&scene, 2);
    answer(&scene, short_id, 1);
    CHECK_EQUAL(take(&scene), 1);
    answer(&scene, short_id, 1);
    check_waits(&scene, 0, 100 * MS);
    answer(&scene, short_id, 1);
    check_told(&scene, 1);
    answer(&scene, short_id, 1); // one more than expected
    check_told(&scene, 1);
    CHECK_EQUAL(take(&scene), 3);
    let_wait_together(&scene, 0);
    for (int i = 0; i < 5; i++)
        answer(&scene, short_id, 1);
    check_waits(&scene, 1, 100 * MS);
    io_free(scene.bus);
}

static void ids_are_compared_whole(void) {
    struct scene scene;
    const uint8_t with_values[] = {0x81, 0x12, 7};
    begin(&scene);
    let_wait(&scene, long_id, 2, 100 * MS);
    answer(&scene, with_values, 3);
    check_waits(&scene, 0, 100 * MS);
    answer(&scene, with_values, 1); // of a response that is shorter than an id
    check_told(&scene, 1);
    take(&scene);
    let_wait(&scene, long_id, 1, 0); // another id
    answer(&scene, long_id, 2);
    check_waits(&scene, 1, 100 * MS);
    io_free(scene.bus);
}

static void the_least_patience_counts(void) {
    struct scene scene;
    begin(&scene);
    let_wait(&scene, short_id, 1, 1000 * MS);
    let_wait(&scene, long_id, 2, 100 * MS);
    answer(&scene, long_id, 2);
    time_passes(&scene, 10 * MS);
    answer(&scene, short_id, 1);
    check_waits(&scene, 0, 90 * MS);
    take(&scene);
    answer(&scene, short_id, 1);
    answer(&scene, long_id, 2);
    check_waits(&scene, 0, 100 * MS);
    io_free(scene.bus);
}

static void a_patience_may_change_and_end(void) {
    struct scene scene;
    begin(&scene);
    let_wait(&scene, short_id, 1, 100 * MS);
    let_wait(&scene, short_id, 1, 200 * MS);
    answer(&scene, short_id, 1);
    check_waits(&scene, 0, 200 * MS);
    take(&scene);
    let_wait(&scene, short_id, 1, 0);
    answer(&scene, short_id, 1);
    check_told(&scene, 1);
    io_free(scene.bus);
}

static void nothing_waits_in_a_hurry(void) {
    struct scene scene;
    uint32_t other;
    begin(&scene);
    let_wait(&scene, short_id, 1, 100 * MS);
    open_other(&scene, &other);
    CHECK_EQUAL(io_let_wait(scene.bus, other, short_id, 1, 100 * MS, 0), IO_OK);
    CHECK_EQUAL(io_hurry(scene.bus, scene.link, 2), IO_OK);
    other_says(&scene, short_id, 1);
    check_waits(&scene, 0, 100 * MS);
    answer(&scene, short_id, 1);
    check_told(&scene, 1);
    take(&scene);
    CHECK_EQUAL(io_hurry(scene.bus, scene.link, 0), IO_OK);
    answer(&scene, short_id, 1);
    check_waits(&scene, 1, 100 * MS);
    io_free(scene.bus);
}

static void there_is_room_for_a_few_and_freed_room_is_used(void) {
    struct scene scene;
    uint32_t other;
    begin(&scene);
    for (uint8_t id = 0; id < IO_PATIENT_MAX; id++)
        let_wait(&scene, &id, 1, 100 * MS);
    CHECK_EQUAL(io_let_wait(scene.bus, scene.link, short_id, 1, 100 * MS, 0), IO_FULL);
    open_other(&scene, &other);
    CHECK_EQUAL(io_let_wait(scene.bus, other, short_id, 1, 100 * MS, 0), IO_OK); // each link has its own
    const uint8_t first = 0, last = IO_PATIENT_MAX - 1;
    let_wait(&scene, &first, 1, 0);
    let_wait(&scene, &last, 1, 300 * MS);
    answer(&scene, &last, 1);
    check_waits(&scene, 0, 300 * MS);
    take(&scene);
    let_wait(&scene, short_id, 1, 200 * MS);
    CHECK_EQUAL(io_let_wait(scene.bus, scene.link, &first, 1, 100 * MS, 0), IO_FULL);
    answer(&scene, &last, 1);
    check_waits(&scene, 0, 300 * MS);
    answer(&scene, short_id, 1);
    check_waits(&scene, 0, 200 * MS);
    io_free(scene.bus);
}

static void what_is_no_id_or_no_link_is_refused(void) {
    struct scene scene;
    const uint8_t id[IO_ID_MAX + 1] = {0x81, 0x81, 0x81, 0x81, 1, 1};
    begin(&scene);
    CHECK_EQUAL(io_let_wait(scene.bus, scene.link, id, 0, 1, 0), IO_INVALID);
    CHECK_EQUAL(io_let_wait(scene.bus, scene.link, id, IO_ID_MAX + 1, 1, 0), IO_INVALID);
    CHECK_EQUAL(io_let_wait(scene.bus, scene.link, id, IO_ID_MAX, 1, 0), IO_OK);
    CHECK_EQUAL(io_let_wait(scene.bus, 999, id, 1, 1, 0), IO_GONE);
    CHECK_EQUAL(io_hurry(scene.bus, 999, 1), IO_GONE);
    io_free(scene.bus);
}

int main(void) {
    it_is_told_when_it_has_waited();
    who_takes_it_before_is_not_told();
    what_may_not_wait_is_told_at_once_and_takes_it_along();
    ids_are_compared_whole();
    all_that_come_together_are_told_at_once();
    what_was_taken_does_not_count_among_those_that_wait();
    the_least_patience_counts();
    a_patience_may_change_and_end();
    nothing_waits_in_a_hurry();
    there_is_room_for_a_few_and_freed_room_is_used();
    what_is_no_id_or_no_link_is_refused();
    return 0;
}
