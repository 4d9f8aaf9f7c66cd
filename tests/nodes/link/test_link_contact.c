// SPDX-License-Identifier: Apache-2.0
// sources: firmware/wire/*.c nodes/link/core/link*.c nodes/link/core/queue.c
// First contact: an empty block asks for the node's sequence, a second one makes sure, and both end in time.
#include "tests/nodes/link/link_scene.h"

static unsigned asked_sequence(const struct scene *scene, size_t size) {
    return scene->out[size - WIRE_BLOCK_MIN + 1] & 15u;
}

static void nothing_is_asked_without_a_command(void) {
    struct scene scene;
    open_link(&scene, WINDOW, SECOND);
    CHECK_EQUAL(go(&scene), 0);
    CHECK_EQUAL(offer_of(&scene, LINK_ALL).kind, LINK_CLASSES);
    CHECK_EQUAL(deadline_of(&scene), NEVER);
    CHECK_EQUAL(link_pending(&scene.link), 0);
    CHECK_EQUAL(link_unanswered_since(&scene.link), NEVER);
    answer(&scene, 5, 0); // left over from before
    answer(&scene, 0, 4);
    CHECK_EQUAL(scene.link.state, LINK_PROBING);
    CHECK_EQUAL(stats_of(&scene).blocks_received, 2);
}

// One command of any class is enough, and of the first block nothing can be lost.
static void the_first_block_is_empty_and_flushes(void) {
    for (int kind = 0; kind < LINK_CLASSES; kind++) {
        struct scene scene;
        open_link(&scene, WINDOW, SECOND);
        if (kind == LINK_MOTION)
            motion(&scene, 'm', 4, 0, 0);
        else
            CHECK_EQUAL(try_send(&scene, (enum link_class)kind, 'c', 4, 0, 0), LINK_OK);
        answer(&scene, 5, 0); // nobody asked
        CHECK_EQUAL(scene.link.state, LINK_PROBING);
        CHECK_OFFER(&scene, LINK_CONTROL, 0, 0);
        check_block(&scene, go(&scene), 59, "");
        CHECK_EQUAL(asked_sequence(&scene, 64), 0);
        CHECK_EQUAL(go(&scene), 0);
        CHECK_EQUAL(offer_of(&scene, LINK_ALL).kind, LINK_CLASSES);
        CHECK_EQUAL(deadline_of(&scene), scene.now + 100 * MS);
        CHECK_EQUAL(link_pending(&scene.link), 1);
        struct link_stats stats = stats_of(&scene);
        CHECK_EQUAL(stats.blocks_sent, 1);
        CHECK_EQUAL(stats.bytes_sent, 64);
        CHECK_EQUAL(stats.commands_sent, 0);
        CHECK_EQUAL(stats.rto_ns, 100 * MS);
    }
}

static void any_sequence_is_adopted_and_made_sure_of(void) {
    for (unsigned expected = 0; expected < 16; expected++) {
        struct scene scene;
        open_link(&scene, WINDOW, SECOND);
        control(&scene, 'c', 2);
        CHECK_EQUAL(go(&scene), 64);
        answer(&scene, expected, 0);
        CHECK_EQUAL(scene.link.state, LINK_CONFIRMING);
        CHECK_EQUAL(scene.link.in_flight_bytes, 0);
        answer(&scene, expected, 0); // once more, before the next question
        answer(&scene, expected + 1, 0);
        CHECK_EQUAL(scene.link.state, LINK_CONFIRMING);
        check_goes(&scene, "");
        CHECK_EQUAL(asked_sequence(&scene, 5), expected);
        answer(&scene, expected, 0); // to the first question
        CHECK_EQUAL(go(&scene), 0);
        answer(&scene, expected + 5, 0); // refused
        CHECK_EQUAL(scene.link.state, LINK_CONFIRMING);
        CHECK_EQUAL(go(&scene), 5);
        CHECK_EQUAL(asked_sequence(&scene, 5), (expected + 5) % 16);
        CHECK_EQUAL(stats_of(&scene).srtt_ns, 0);
        scene.now += 3 * MS;
        answer(&scene, expected + 6, 0); // taken
        CHECK_EQUAL(scene.link.state, LINK_RUNNING);
        CHECK_EQUAL(stats_of(&scene).srtt_ns, 3 * MS);
        CHECK_EQUAL(deadline_of(&scene), NEVER);
        check_goes(&scene, "cc");
        CHECK_EQUAL(scene.out[1] & 15, (expected + 6) % 16);
        CHECK_EQUAL(stats_of(&scene).blocks_repeated, 0);
        CHECK_EQUAL(stats_of(&scene).naks, 0);
    }
}

// What asks goes again by time alone; what the repeats may cause is forgotten with the sequence.
static void a_lost_question_is_repeated(void) {
    struct scene scene;
    open_link(&scene, WINDOW, SECOND);
    control(&scene, 'c', 2);
    CHECK_EQUAL(go(&scene), 64);
    scene.now += 100 * MS;
    link_handle_timer(&scene.link, scene.now);
    CHECK_EQUAL(scene.link.naks_outstanding, 1);
    CHECK_OFFER(&scene, LINK_CONTROL, 0, 0);
    check_block(&scene, go(&scene), 59, "");
    CHECK_EQUAL(deadline_of(&scene), scene.now + 125 * MS);
    answer(&scene, 9, 0);
    CHECK_EQUAL(scene.link.naks_outstanding, 0);
    CHECK_EQUAL(scene.link.in_flight_bytes, 0);
    check_goes(&scene, "");
    scene.now += 125 * MS;
    link_handle_timer(&scene.link, scene.now);
    CHECK_EQUAL(scene.link.naks_outstanding, 1);
    check_block(&scene, go(&scene), 59, "");
    answer(&scene, 10, 0);
    CHECK_EQUAL(scene.link.state, LINK_RUNNING);
    CHECK_EQUAL(scene.link.naks_outstanding, 0);
    CHECK_EQUAL(scene.link.in_flight_bytes, 0);
    struct link_stats stats = stats_of(&scene);
    CHECK_EQUAL(stats.timeouts, 2);
    CHECK_EQUAL(stats.blocks_repeated, 2);
    CHECK_EQUAL(stats.bytes_repeated, 128);
    CHECK_EQUAL(stats.srtt_ns, 1); // the time since the last repeat, which no round trip is shorter than
}

// The answer that made sure counts as the node's last word: the same once more refuses what was sent since.
static void the_first_refusal_of_a_running_link_is_heard(void) {
    struct scene scene;
    open_link(&scene, WINDOW, SECOND);
    control(&scene, 'c', 2);
    for (unsigned i = 1; i <= 2; i++) {
        CHECK(go(&scene) > 0);
        answer(&scene, i, 0);
    }
    check_goes(&scene, "cc");
    answer(&scene, 2, 0);
    CHECK_EQUAL(stats_of(&scene).naks, 1);
    check_block(&scene, go(&scene), 1, "cc");
}

// However often the sequence is refused: the link is lost at the usual time after the first question.
static void first_contact_as_a_whole_ends_in_time(void) {
    struct scene scene;
    open_link(&scene, WINDOW, SECOND);
    control(&scene, 'c', 2);
    uint64_t lost_ns = scene.now + SECOND;
    for (unsigned i = 0; i < 19; i++) {
        CHECK(go(&scene) > 0);
        scene.now += 50 * MS;
        link_handle_timer(&scene.link, scene.now);
        answer(&scene, 3 * i + 2, 0);
        CHECK_EQUAL(scene.link.state, LINK_CONFIRMING);
        CHECK_EQUAL(deadline_of(&scene), lost_ns); // although nothing is in flight
    }
    scene.now = lost_ns - 1;
    link_handle_timer(&scene.link, scene.now);
    CHECK_EQUAL(scene.link.state, LINK_CONFIRMING);
    scene.now = lost_ns;
    link_handle_timer(&scene.link, scene.now);
    CHECK_EQUAL(scene.link.state, LINK_LOST);
    CHECK_EQUAL(scene.link.cause, LINK_CAUSE_STUCK);
}

static void a_response_before_commands_went_has_no_question(void) {
    struct scene scene;
    open_link(&scene, WINDOW, SECOND);
    control(&scene, 'c', 2);
    CHECK_EQUAL(go(&scene), 64);
    answer(&scene, 1, 0);
    CHECK_EQUAL(scene.link.state, LINK_CONFIRMING);
    CHECK_EQUAL(answer(&scene, 1, 3), 1);
    CHECK_EQUAL(scene.response.sent_ns, 0);
    CHECK_EQUAL(scene.response.received_ns, scene.now);
}

// What a clock holds back does not hold back the questions, nor wake anybody before the node is known.
static void clocks_do_not_matter_yet(void) {
    struct scene scene;
    open_link(&scene, WINDOW, SECOND);
    CHECK_EQUAL(link_set_clock(&scene.link, 512, scene.now, 1000), LINK_OK);
    CHECK_EQUAL(try_send(&scene, LINK_CONTROL, 'c', 2, 1010, 0), LINK_OK);
    CHECK_EQUAL(deadline_of(&scene), NEVER);
    CHECK_EQUAL(go_of(&scene, 0), 64);
    CHECK_EQUAL(deadline_of(&scene), scene.now + 100 * MS);
    answer(&scene, 1, 0);
    CHECK_EQUAL(deadline_of(&scene), scene.now + SECOND);
}

int main(void) {
    nothing_is_asked_without_a_command();
    the_first_block_is_empty_and_flushes();
    any_sequence_is_adopted_and_made_sure_of();
    a_lost_question_is_repeated();
    the_first_refusal_of_a_running_link_is_heard();
    first_contact_as_a_whole_ends_in_time();
    a_response_before_commands_went_has_no_question();
    clocks_do_not_matter_yet();
    return 0;
}
