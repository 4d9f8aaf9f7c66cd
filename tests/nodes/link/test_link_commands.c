// SPDX-License-Identifier: Apache-2.0
// sources: firmware/wire/*.c nodes/link/core/link*.c nodes/link/core/queue.c
// What is handed to a link: what it takes, what it refuses, and what an urgent command drops.
#include "tests/nodes/link/link_scene.h"

static void a_command_fills_a_block_at_most(void) {
    static const struct {
        size_t size;
        enum link_status status;
    } cases[] = {{0, LINK_INVALID}, {1, LINK_OK},       {2, LINK_OK},
                 {59, LINK_OK},     {60, LINK_INVALID}, {255, LINK_INVALID}};
    for (size_t i = 0; i < sizeof cases / sizeof *cases; i++) {
        struct scene scene;
        open_running(&scene, WINDOW);
        size_t size = cases[i].size, taken = cases[i].status == LINK_OK;
        CHECK_EQUAL(try_send(&scene, LINK_CONTROL, 'c', size, 0, 0), cases[i].status);
        CHECK_EQUAL(try_send(&scene, LINK_BULK, 'b', size, 0, 0), cases[i].status);
        CHECK_EQUAL(try_motion(&scene, 'm', size, 0, 0), cases[i].status);
        CHECK_EQUAL(link_pending(&scene.link), 3 * taken);
        CHECK_EQUAL(urgent(&scene, 'u', size), cases[i].status);
        CHECK_EQUAL(link_pending(&scene.link), taken); // what is refused drops nothing
        CHECK_EQUAL(stats_of(&scene).commands_dropped, 3 * taken);
        CHECK_EQUAL(try_send(&scene, LINK_MOTION, 'm', size, 0, 0), LINK_INVALID); // goes in batches
        CHECK_EQUAL(try_send(&scene, LINK_CLASSES, 'm', size, 0, 0), LINK_INVALID);
        CHECK_EQUAL(link_pending(&scene.link), taken);
    }
}

static void a_refused_urgent_command_leaves_all_as_it_was(void) {
    struct scene scene;
    open_running(&scene, WINDOW);
    control(&scene, 'c', 1);
    motion(&scene, 'm', 1, 0, 0);
    bulk(&scene, 'b', 1);
    CHECK_EQUAL(urgent(&scene, 'u', 0), LINK_INVALID);
    CHECK_EQUAL(urgent(&scene, 'u', 60), LINK_INVALID);
    CHECK_EQUAL(stats_of(&scene).commands_dropped, 0);
    CHECK_OFFER(&scene, LINK_MOTION, scene.now, 0);
    check_goes(&scene, "mcb");
}

static void batches_are_taken_whole_or_not_at_all(void) {
    struct scene scene;
    open_running(&scene, WINDOW);
    uint8_t batch[4 * (BATCH_HEADER + 60)], content[60];
    memset(content, 'm', sizeof content);
    CHECK_EQUAL(link_send_batch(&scene.link, batch, 0), LINK_OK);
    CHECK_EQUAL(link_pending(&scene.link), 0);
    size_t size = 0, third = 0;
    static const uint8_t sizes[] = {1, 3, 59};
    for (unsigned i = 0; i < 3; i++) {
        third = size;
        size += batch_write(batch + size, 0, 0, content, sizes[i]);
    }
    for (size_t cut = 1; cut < size; cut++) {
        int whole = cut == 18 || cut == third;
        CHECK_EQUAL(link_send_batch(&scene.link, batch, cut), whole ? LINK_OK : LINK_INVALID);
    }
    CHECK_EQUAL(link_pending(&scene.link), 3);
    CHECK_EQUAL(link_send_batch(&scene.link, batch, size), LINK_OK);
    CHECK_EQUAL(link_pending(&scene.link), 6);
    size_t longer = size + batch_write(batch + size, 0, 0, content, 60);
    CHECK_EQUAL(link_send_batch(&scene.link, batch, longer), LINK_INVALID);
    longer = size + batch_write(batch + size, 0, 0, content, 0);
    CHECK_EQUAL(link_send_batch(&scene.link, batch, longer), LINK_INVALID);
    CHECK_EQUAL(link_pending(&scene.link), 6);
    check_goes(&scene, "mmmmmmmmm"); // 1, 1 + 3, 1 + 3
}

static void a_full_queue_takes_nothing(void) {
    struct scene scene;
    open_running(&scene, WINDOW);
    for (unsigned i = 0; i < 4096 / (BATCH_HEADER + 47); i++) // 64 bytes each: full to the last
        motion(&scene, 'm', 47, 0, 0);
    CHECK_EQUAL(try_motion(&scene, 'm', 1, 0, 0), LINK_FULL);
    for (unsigned i = 0; i < 4096 / (BATCH_HEADER + 8 + 39); i++) {
        control(&scene, 'c', 39);
        bulk(&scene, 'b', 39);
    }
    CHECK_EQUAL(try_send(&scene, LINK_CONTROL, 'c', 1, 0, 0), LINK_FULL);
    CHECK_EQUAL(try_send(&scene, LINK_BULK, 'c', 1, 0, 0), LINK_FULL);
    CHECK_EQUAL(link_pending(&scene.link), 3 * 64);
    CHECK_EQUAL(go(&scene), 5 + 47);
    CHECK_EQUAL(try_motion(&scene, 'm', 47, 0, 0), LINK_OK);
    CHECK_EQUAL(link_pending(&scene.link), 3 * 64 + 1);
    CHECK_EQUAL(urgent(&scene, 'u', 59), LINK_OK);
    CHECK_EQUAL(link_pending(&scene.link), 2);
    CHECK_EQUAL(stats_of(&scene).commands_dropped, 3 * 64);
    CHECK_EQUAL(stats_of(&scene).commands_sent, 2);
}

// What went before stays what it is, whatever its slot held.
static void an_urgent_command_drops_what_did_not_go(void) {
    struct scene scene;
    open_running(&scene, 4096);
    for (unsigned i = 0; i < 15; i++) { // blocks of four commands in all slots but one
        for (unsigned k = 0; k < 4; k++)
            motion(&scene, 'm', 1, 0, 1);
        check_goes(&scene, "mmmm");
    }
    motion(&scene, 'm', 1, 0, 1);
    motion(&scene, 'm', 1, 0, 1);
    control(&scene, 'c', 1);
    bulk(&scene, 'b', 1);
    bulk(&scene, 'b', 1);
    bulk(&scene, 'b', 1);
    CHECK_EQUAL(urgent(&scene, 'u', 3), LINK_OK);
    CHECK_EQUAL(stats_of(&scene).commands_dropped, 6);
    CHECK_EQUAL(link_pending(&scene.link), 61);
    answer(&scene, scene.link.first + 3, 0);
    CHECK_EQUAL(link_pending(&scene.link), 49);
    const struct link_queue *queue = &scene.link.queues[LINK_CONTROL];
    struct link_command command;
    link_queue_peek(queue, queue->head, &command);
    CHECK_EQUAL(command.min_clock, 0);
    CHECK_EQUAL(command.req_clock, 0);
    CHECK_EQUAL(command.queued_ns, scene.now);
    check_goes(&scene, "uuu");
    CHECK_EQUAL(go(&scene), 0);
}

static void a_window_holds_a_block_at_least(void) {
    struct scene scene;
    open_running(&scene, 192);
    CHECK_EQUAL(link_set_receive_window(&scene.link, 0), LINK_INVALID);
    CHECK_EQUAL(link_set_receive_window(&scene.link, 63), LINK_INVALID);
    control(&scene, 'a', 59);
    CHECK_EQUAL(go(&scene), 64);
    control(&scene, 'b', 59);
    CHECK_EQUAL(go(&scene), 64); // what was refused changed nothing
    CHECK_EQUAL(link_set_receive_window(&scene.link, 64), LINK_OK);
    acknowledge_all(&scene);
    control(&scene, 'c', 59);
    control(&scene, 'd', 1);
    CHECK_EQUAL(go(&scene), 64);
    CHECK_EQUAL(go(&scene), 0);
    CHECK_EQUAL(link_set_receive_window(&scene.link, 70), LINK_OK);
    CHECK_EQUAL(go(&scene), 6);
}

// A link carries on over many turns of its sequence and of its slots.
static void a_long_life_repeats_nothing(void) {
    struct scene scene;
    open_running(&scene, 192);
    struct link_stats before = stats_of(&scene);
    for (unsigned i = 0; i < 100; i++) {
        control(&scene, 'c', 1 + i % 50);
        CHECK_EQUAL(go(&scene), 6 + i % 50);
        CHECK_EQUAL(scene.out[1] & 15, (3 + i) % 16);
        if (i % 3)
            acknowledge_all(&scene);
    }
    acknowledge_all(&scene);
    struct link_stats after = stats_of(&scene);
    CHECK_EQUAL(after.blocks_sent - before.blocks_sent, 100);
    CHECK_EQUAL(after.bytes_sent - before.bytes_sent, 2 * (50 * 6 + 49 * 25));
    CHECK_EQUAL(after.commands_sent - before.commands_sent, 100);
    CHECK_EQUAL(after.blocks_repeated, 0);
    CHECK_EQUAL(after.bytes_repeated, 0);
    CHECK_EQUAL(link_pending(&scene.link), 0);
    CHECK_EQUAL(scene.link.in_flight_bytes, 0);
}

int main(void) {
    a_command_fills_a_block_at_most();
    a_refused_urgent_command_leaves_all_as_it_was();
    batches_are_taken_whole_or_not_at_all();
    a_full_queue_takes_nothing();
    an_urgent_command_drops_what_did_not_go();
    a_window_holds_a_block_at_least();
    a_long_life_repeats_nothing();
    return 0;
}
