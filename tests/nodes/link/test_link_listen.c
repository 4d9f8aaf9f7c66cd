// SPDX-License-Identifier: Apache-2.0
// sources: firmware/wire/*.c nodes/link/core/link*.c nodes/link/core/queue.c
// What a link makes of bytes: blocks and their responses, damage, blocks that are cut off, leads.
#include "tests/nodes/link/link_scene.h"

// A block with SIZE bytes of content, for the sequence that the link expects; returns its length.
static size_t make_block(const struct scene *scene, uint8_t *out, size_t size) {
    memset(out, 'r', WIRE_HEADER + size);
    return wire_block_finish(out, size, (unsigned)scene->link.first);
}

static void time_passes(struct scene *scene, uint64_t at_ns) {
    scene->now = at_ns;
    CHECK_EQUAL(comes(scene, NULL, 0), 0);
}

// ----------------------------------------------------------------------------------------------- responses

static void a_response_knows_its_question_when_that_is_sure(void) {
    enum { SURE, STALE, REPEATED, CASES };
    for (int i = 0; i < CASES; i++) {
        struct scene scene;
        open_running(&scene, WINDOW);
        scene.now += 7 * MS;
        uint64_t sent_ns = scene.now;
        control(&scene, 'c', 1);
        check_goes(&scene, "c");
        if (i == REPEATED) {
            scene.now += 20 * MS;
            link_handle_timer(&scene.link, scene.now);
            CHECK_EQUAL(go(&scene), 64);
        }
        scene.now += 3 * MS;
        CHECK_EQUAL(answer(&scene, scene.link.next + (i == STALE ? 3 : 0), 9), 1);
        CHECK_EQUAL(scene.response.sent_ns, i == SURE ? sent_ns : 0);
        CHECK_EQUAL(scene.response.received_ns, scene.now);
        CHECK_EQUAL(scene.response.size, 9);
        CHECK(memcmp(scene.response.content, "rrrrrrrrr", 9) == 0);
        CHECK_EQUAL(scene.link.heard_ns, scene.now);
        CHECK_EQUAL(link_pending(&scene.link), i == STALE ? 1 : 0);
    }
}

static void responses_of_every_size_come_in_one_piece_or_many(void) {
    struct scene scene;
    open_running(&scene, WINDOW);
    uint8_t data[LINK_BLOCKS_MAX * WIRE_BLOCK_MAX * 4];
    size_t size = 0, content = 0;
    for (size_t i = 1; i <= WIRE_CONTENT_MAX; i++) {
        if (size + i + 5 > sizeof data)
            break;
        size += make_block(&scene, data + size, i);
        content = i;
    }
    struct link_stats before = stats_of(&scene);
    CHECK_EQUAL(comes(&scene, data, size), content);
    CHECK_EQUAL(scene.response.size, content);
    CHECK_EQUAL(stats_of(&scene).bytes_received - before.bytes_received, size);
    CHECK_EQUAL(stats_of(&scene).blocks_received - before.blocks_received, content);
    unsigned found = 0;
    for (size_t at = 0; at < size; at++)
        found += comes(&scene, data + at, 1);
    CHECK_EQUAL(found, content);
    CHECK_EQUAL(stats_of(&scene).bytes_invalid, 0);
    CHECK_EQUAL(deadline_of(&scene), NEVER);
}

// Sync bytes in front of a block are legal, and no part of it.
static void sync_bytes_may_stand_in_front(void) {
    struct scene scene;
    open_running(&scene, WINDOW);
    control(&scene, 'c', 1);
    check_goes(&scene, "c");
    uint8_t data[64];
    memset(data, WIRE_SYNC, sizeof data);
    size_t size = 3;
    memset(data + size, 's', 9);
    size += wire_block_finish(data + size, 4, (unsigned)scene.link.next);
    size += 2;
    memset(data + size, 't', 9);
    size += wire_block_finish(data + size, 2, (unsigned)scene.link.next);
    const uint8_t *at = data;
    struct link_response response;
    CHECK_EQUAL(link_receive(&scene.link, &at, &size, scene.now, &response), 1);
    CHECK_EQUAL(response.size, 4);
    CHECK(memcmp(response.content, "ssss", 4) == 0);
    CHECK_EQUAL(link_pending(&scene.link), 0);
    CHECK_EQUAL(link_receive(&scene.link, &at, &size, scene.now, &response), 1);
    CHECK_EQUAL(response.size, 2);
    CHECK(memcmp(response.content, "tt", 2) == 0);
    CHECK_EQUAL(stats_of(&scene).bytes_invalid, 0);
}

// ------------------------------------------------------------------------------------------------- damage

static void damage_is_counted_and_is_no_response(void) {
    static const struct {
        uint8_t data[8];
        size_t size;
        uint64_t invalid; // with all that came before
    } pieces[] = {
        {{0xFF, 1, 2, WIRE_SYNC}, 4, 4},
        {{WIRE_SYNC, WIRE_SYNC, WIRE_SYNC}, 3, 4}, // legal
        {{3}, 1, 5},                               // no length: everything to the next sync byte is dropped
        {{4, 5}, 2, 7},
        {{6, WIRE_SYNC, WIRE_SYNC}, 3, 10},
        {{5, 0x10, 0, 0, WIRE_SYNC}, 5, 15}, // a wrong checksum
    };
    struct scene scene;
    open_running(&scene, WINDOW);
    for (size_t i = 0; i < sizeof pieces / sizeof *pieces; i++) {
        CHECK_EQUAL(comes(&scene, pieces[i].data, pieces[i].size), 0);
        CHECK_EQUAL(stats_of(&scene).bytes_invalid, pieces[i].invalid);
    }
    CHECK_EQUAL(answer(&scene, scene.link.first, 2), 1);
    CHECK_EQUAL(stats_of(&scene).bytes_invalid, 15);
}

// -------------------------------------------------------------------------------------- what was cut off

// The first SIZE bytes of a block with 20 come, and so long no more.
static void open_cut_off(struct scene *scene, size_t size) {
    uint8_t block[WIRE_BLOCK_MAX];
    open_running(scene, WINDOW);
    make_block(scene, block, 20);
    CHECK_EQUAL(comes(scene, block, size), 0);
    CHECK_EQUAL(deadline_of(scene), scene->now + 100 * MS);
}

static void the_rest_comes(struct scene *scene, size_t from) {
    uint8_t block[WIRE_BLOCK_MAX];
    size_t length = make_block(scene, block, 20);
    CHECK_EQUAL(comes(scene, block + from, length - from), 1);
    CHECK_EQUAL(stats_of(scene).bytes_invalid, 0);
}

static void a_rest_that_does_not_come_is_given_up(void) {
    for (uint64_t late_ns = 0; late_ns <= 10 * MS; late_ns += 5 * MS) {
        struct scene scene;
        open_cut_off(&scene, 3);
        uint64_t end_ns = scene.now + 100 * MS;
        time_passes(&scene, end_ns - 1);
        CHECK_EQUAL(stats_of(&scene).bytes_invalid, 0);
        CHECK_EQUAL(deadline_of(&scene), end_ns);
        time_passes(&scene, end_ns + late_ns);
        CHECK_EQUAL(stats_of(&scene).bytes_invalid, 3);
        CHECK_EQUAL(deadline_of(&scene), NEVER);
    }
}

// The last of its bytes begins the wait, and time alone does not end it before it is looked at.
static void a_rest_that_comes_is_waited_for(void) {
    struct scene scene;
    open_cut_off(&scene, 3);
    uint8_t block[WIRE_BLOCK_MAX];
    make_block(&scene, block, 20);
    scene.now += 60 * MS;
    CHECK_EQUAL(comes(&scene, block + 3, 1), 0);
    CHECK_EQUAL(deadline_of(&scene), scene.now + 100 * MS);
    scene.now += 105 * MS; // nobody looked
    the_rest_comes(&scene, 4);
    open_cut_off(&scene, 3);
    scene.now += 500 * MS;
    the_rest_comes(&scene, 3);
}

// Who looks much later than he was to waits once more, but only once for the same bytes.
static void who_stood_still_waits_once_more(void) {
    struct scene scene;
    open_cut_off(&scene, 3);
    time_passes(&scene, scene.now + 110 * MS + 1);
    CHECK_EQUAL(stats_of(&scene).bytes_invalid, 0);
    CHECK_EQUAL(deadline_of(&scene), scene.now + 100 * MS);
    uint64_t end_ns = scene.now + 100 * MS;
    time_passes(&scene, end_ns - 1);
    CHECK_EQUAL(stats_of(&scene).bytes_invalid, 0);
    time_passes(&scene, end_ns + 500 * MS);
    CHECK_EQUAL(stats_of(&scene).bytes_invalid, 3);

    open_cut_off(&scene, 3);
    uint8_t block[WIRE_BLOCK_MAX];
    make_block(&scene, block, 20);
    for (size_t at = 3; at < 6; at++) { // each further byte is waited for as the first
        time_passes(&scene, scene.now + 300 * MS);
        CHECK_EQUAL(comes(&scene, block + at, 1), 0);
    }
    time_passes(&scene, scene.now + 300 * MS);
    the_rest_comes(&scene, 6);
}

// Sound blocks behind a length byte that asked for more are found when the wait is over.
static void what_is_behind_a_block_that_was_cut_off_is_heard(void) {
    struct scene scene;
    open_running(&scene, WINDOW);
    uint8_t data[64] = {30, 0x10, 'x', WIRE_SYNC};
    size_t size = 4;
    size += make_block(&scene, data + size, 2);
    size += make_block(&scene, data + size, 3);
    memcpy(data + size, "\10\20", 2); // and one more that is cut off
    size += 2;
    CHECK_EQUAL(comes(&scene, data, size), 0);
    scene.now += 100 * MS;
    CHECK_EQUAL(comes(&scene, NULL, 0), 2);
    CHECK_EQUAL(scene.response.size, 3);
    CHECK_EQUAL(stats_of(&scene).bytes_invalid, 6); // what is left came no later
    CHECK_EQUAL(deadline_of(&scene), NEVER);
}

static void the_end_of_a_wait_wakes_before_a_later_repeat(void) {
    struct scene scene;
    open_link(&scene, WINDOW, SECOND);
    run_up(&scene, 200 * MS); // a timeout of 125 ms
    uint8_t cut_off[] = {20, 0x10};
    control(&scene, 'c', 1);
    check_goes(&scene, "c");
    uint64_t sent_ns = scene.now;
    comes(&scene, cut_off, 2);
    CHECK_EQUAL(deadline_of(&scene), sent_ns + 100 * MS);
    scene.now += 60 * MS;
    comes(&scene, cut_off, 1);
    CHECK_EQUAL(deadline_of(&scene), sent_ns + 125 * MS);
}

// --------------------------------------------------------------------------------------------------- leads

enum { HZ = 1 << 19, START = 7 };

// A command that is due at DUE_NS is acknowledged LEAD_NS before.
static void lead(struct scene *scene, unsigned commands, int64_t lead_ns) {
    const uint64_t due_s = 1100;
    uint64_t sent_ns = scene->now;
    CHECK_EQUAL(link_set_clock(&scene->link, HZ, sent_ns, START), LINK_OK);
    for (unsigned i = 0; i < commands; i++)
        motion(scene, 'm', 2, 0, START + due_s * HZ);
    CHECK(go(scene) > 0);
    scene->now = sent_ns + due_s * SECOND - (uint64_t)lead_ns;
    acknowledge_all(scene);
    scene->now = sent_ns;
}

static void leads_are_counted_by_powers_of_two(void) {
    struct scene scene;
    open_running(&scene, WINDOW);
    uint64_t expected[16] = {0}, count = 0;
    for (unsigned power = 0; power < 14; power++) {
        int64_t edge_ns = (int64_t)(MS << power);
        lead(&scene, 1, edge_ns);
        expected[power + 2 < 15 ? power + 2 : 15]++;
        lead(&scene, 2, edge_ns - 1);
        expected[power + 1] += 2;
        count += 3;
        CHECK_EQUAL(stats_of(&scene).lead_count, count);
        CHECK_EQUAL(stats_of(&scene).lead_min_ns, MS - 1);
    }
    lead(&scene, 1, (int64_t)(MS << 14));
    lead(&scene, 1, (int64_t)(MS << 20));
    expected[15] += 2;
    lead(&scene, 1, 0);
    expected[1]++;
    CHECK_EQUAL(stats_of(&scene).lead_min_ns, 0);
    lead(&scene, 3, -1);
    lead(&scene, 1, -(int64_t)(MS << 20));
    lead(&scene, 1, -5);
    expected[0] += 5;
    CHECK_EQUAL(stats_of(&scene).lead_min_ns, -(int64_t)(MS << 20));
    CHECK_EQUAL(stats_of(&scene).lead_count, count + 8);
    for (unsigned i = 0; i < 16; i++)
        CHECK_EQUAL(stats_of(&scene).lead_histogram[i], expected[i]);
}

static void only_motion_with_a_time_has_a_lead(void) {
    struct scene scene;
    open_running(&scene, WINDOW);
    motion(&scene, 'm', 2, 0, 5); // no clock yet
    check_goes(&scene, "mm");
    acknowledge_all(&scene);
    CHECK_EQUAL(stats_of(&scene).lead_count, 0);
    CHECK_EQUAL(link_set_clock(&scene.link, 0.5, scene.now, START), LINK_OK);
    motion(&scene, 'm', 2, 0, 0);
    CHECK_EQUAL(try_send(&scene, LINK_CONTROL, 'c', 1, 0, START), LINK_OK);
    check_goes(&scene, "cmm");
    acknowledge_all(&scene);
    CHECK_EQUAL(stats_of(&scene).lead_count, 0);
    motion(&scene, 'm', 2, 0, START + 1);
    check_goes(&scene, "mm");
    acknowledge_all(&scene);
    CHECK_EQUAL(stats_of(&scene).lead_count, 1);
    CHECK_EQUAL(stats_of(&scene).lead_min_ns, 2 * SECOND);
}

int main(void) {
    a_response_knows_its_question_when_that_is_sure();
    responses_of_every_size_come_in_one_piece_or_many();
    sync_bytes_may_stand_in_front();
    damage_is_counted_and_is_no_response();
    a_rest_that_does_not_come_is_given_up();
    a_rest_that_comes_is_waited_for();
    who_stood_still_waits_once_more();
    what_is_behind_a_block_that_was_cut_off_is_heard();
    the_end_of_a_wait_wakes_before_a_later_repeat();
    leads_are_counted_by_powers_of_two();
    only_motion_with_a_time_has_a_lead();
    return 0;
}
