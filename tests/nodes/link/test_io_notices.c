// SPDX-License-Identifier: Apache-2.0
// sources: firmware/wire/*.c nodes/link/core/*.c nodes/link/io/*.c nodes/support/can_bits.c
// What waits for the program that uses a bus: in which order it is handed over, whatever room there is, when
// the driver says so, and that the counters keep up.
#include <errno.h>
#include <linux/can.h>
#include <string.h>

#include "nodes/link/io/io_api.h"
#include "nodes/link/io/io_bus.h"
#include "tests/check.h"

#define MS 1000000ULL

enum { NODES = 3, FIRST_NODE = 4, OTHER_ID = 0x3F1, FRAME = sizeof(struct can_frame) };

static const struct link_settings usual = {.receive_window = 192, .lost_after_ns = 1000 * MS};

struct scene {
    struct io_bus *bus;
    uint64_t now_ns;
    int notices, quiet;
    uint32_t links[NODES];
};

static uint64_t now_of(void *context) {
    return ((struct scene *)context)->now_ns;
}

static void nothing(void *context) {
    (void)context;
}

static void notify(void *context) {
    ((struct scene *)context)->notices++;
}

static void quiet(void *context) {
    ((struct scene *)context)->quiet++;
}

static void begin(struct scene *scene) {
    static const struct io_driver driver = {now_of, nothing, nothing, nothing, notify, quiet};
    static const struct io_settings unknown_speed = {0};
    *scene = (struct scene){.now_ns = 1000 * MS};
    scene->bus = io_new(IO_CAN_STREAM, &unknown_speed, &driver, scene);
    CHECK(scene->bus);
    CHECK_EQUAL(io_deadline(scene->bus, scene->now_ns), UINT64_MAX);
    for (unsigned i = 0; i < NODES; i++)
        CHECK_EQUAL(io_open_link(scene->bus, FIRST_NODE + i, &usual, &scene->links[i]), IO_OK);
}

static void frame_comes(struct scene *scene, uint32_t can_id, const uint8_t *data, size_t size) {
    struct can_frame frame = {.can_id = can_id, .can_dlc = (uint8_t)size};
    memcpy(frame.data, data, size);
    io_received(scene->bus, (const uint8_t *)&frame, FRAME, scene->now_ns);
}

static void number_comes(struct scene *scene, unsigned number) {
    const uint8_t data[] = {(uint8_t)number, (uint8_t)(number >> 8)};
    frame_comes(scene, OTHER_ID, data, sizeof data);
}

static void response_comes(struct scene *scene, uint8_t value) {
    uint8_t block[WIRE_BLOCK_MAX] = {[WIRE_HEADER] = value};
    CHECK_EQUAL(wire_block_finish(block, 1, 0), 6);
    frame_comes(scene, 0x101 + 2 * FIRST_NODE, block, 6);
}

static void send_all(struct scene *scene) {
    uint8_t out[IO_OUT_FRAMES * FRAME];
    while (io_next(scene->bus, scene->now_ns, 0, out, sizeof out) > 0)
        ;
}

static void send_control(struct scene *scene, unsigned at) {
    const uint8_t content = 5;
    CHECK_EQUAL(io_send(scene->bus, scene->links[at], LINK_CONTROL, &content, 1, 0, 0), IO_OK);
    send_all(scene);
}

// Two links drained, then all lost; responses and frames; the end.
static void let_everything_happen(struct scene *scene) {
    begin(scene);
    for (unsigned i = 0; i < 2; i++)
        CHECK_EQUAL(io_watch_drained(scene->bus, scene->links[i]), IO_OK);
    for (unsigned i = 0; i < NODES; i++)
        send_control(scene, i);
    for (uint8_t value = 1; value <= 2; value++) {
        response_comes(scene, value);
        number_comes(scene, value);
    }
    while (scene->now_ns < 2500 * MS) {
        scene->now_ns += 100 * MS;
        io_handle_time(scene->bus, scene->now_ns);
        send_all(scene);
    }
    io_end(scene->bus, ENETDOWN);
}

static void check_event(const struct scene *scene, const struct io_event *event, size_t at) {
    static const struct {
        enum io_notice notice;
        int link; // of links; -1: none
        int value;
    } wanted[] = {
        {IO_FRAME, -1, 1},
        {IO_FRAME, -1, 2},
        {IO_RESPONSE, 0, 1},
        {IO_RESPONSE, 0, 2},
        {IO_DRAINED, 0, 0},
        {IO_LOST, 0, LINK_CAUSE_SILENT},
        {IO_DRAINED, 1, 0},
        {IO_LOST, 1, LINK_CAUSE_SILENT},
        {IO_LOST, 2, LINK_CAUSE_SILENT},
        {IO_ENDED, -1, ENETDOWN},
    };
    CHECK(at < sizeof wanted / sizeof *wanted);
    int has_content = event->notice == IO_RESPONSE || event->notice == IO_FRAME;
    CHECK_EQUAL(event->notice, wanted[at].notice);
    CHECK_EQUAL(event->link, wanted[at].link < 0 ? 0 : scene->links[wanted[at].link]);
    CHECK_EQUAL(has_content ? event->content[0] : event->value, wanted[at].value);
}

static void notices_come_in_order_whatever_room_there_is(void) {
    enum { EVENTS = 10 };
    for (size_t room = 1; room <= EVENTS + 1; room++) {
        struct scene scene;
        let_everything_happen(&scene);
        struct io_event *events = calloc(room, sizeof *events); // no more, so that the sanitizer sees one
        size_t at = 0, taken = room;
        while (taken == room) {
            CHECK_EQUAL(scene.quiet, 0);
            taken = io_take(scene.bus, events, room);
            CHECK_EQUAL(taken, room < EVENTS - at ? room : EVENTS - at);
            for (size_t i = 0; i < taken; i++)
                check_event(&scene, &events[i], at++);
        }
        CHECK_EQUAL(at, EVENTS);
        CHECK_EQUAL(scene.notices, 1);
        CHECK_EQUAL(scene.quiet, 1);
        CHECK_EQUAL(io_take(scene.bus, events, room), 0); // nothing is told twice
        CHECK_EQUAL(scene.quiet, 2);                      // its notice may come after it was taken
        number_comes(&scene, 9);
        CHECK_EQUAL(scene.notices, 2);
        CHECK_EQUAL(io_take(scene.bus, events, room), 1);
        free(events);
        io_free(scene.bus);
    }
}

static void a_drained_link_is_told_of_once_when_it_is(void) {
    struct scene scene;
    struct io_event event;
    begin(&scene);
    const uint8_t content = 5;
    CHECK_EQUAL(io_send(scene.bus, scene.links[1], LINK_CONTROL, &content, 1, 0, 0), IO_OK);
    CHECK_EQUAL(io_watch_drained(scene.bus, scene.links[1]), IO_OK);
    io_handle_time(scene.bus, scene.now_ns);
    CHECK_EQUAL(scene.notices, 0); // a command is pending
    CHECK_EQUAL(io_watch_drained(scene.bus, scene.links[0]), IO_OK);
    for (int i = 0; i < 2; i++) {
        io_handle_time(scene.bus, scene.now_ns);
        CHECK_EQUAL(scene.notices, 1);
        CHECK_EQUAL(io_take(scene.bus, &event, 1), i == 0);
        CHECK_EQUAL(io_take(scene.bus, &event, 1), 0);
    }
    CHECK_EQUAL(event.notice, IO_DRAINED);
    CHECK_EQUAL(event.link, scene.links[0]);
    io_free(scene.bus);
}

// The node at FIRST_NODE + AT acknowledges what came before SEQUENCE.
static void acknowledge(struct scene *scene, unsigned at, unsigned sequence) {
    uint8_t block[WIRE_BLOCK_MAX];
    CHECK_EQUAL(wire_block_finish(block, 0, sequence), WIRE_BLOCK_MIN);
    frame_comes(scene, 0x101 + 2 * (FIRST_NODE + at), block, WIRE_BLOCK_MIN);
    send_all(scene);
}

static void a_silent_node_is_told_of_again_and_again_until_it_is_lost(void) {
    struct scene scene;
    struct io_event events[2];
    unsigned silences = 0, losses = 0;
    begin(&scene);
    send_control(&scene, 1);
    for (unsigned sequence = 0; sequence < 2; sequence++) // it begins, and is asked again
        acknowledge(&scene, 1, sequence);
    uint64_t asked_ns = scene.now_ns;
    while (!losses) {
        scene.now_ns += 10 * MS;
        io_handle_time(scene.bus, scene.now_ns);
        send_all(&scene);
        size_t taken = io_take(scene.bus, events, 2);
        CHECK(taken < 2);
        if (!taken)
            continue;
        CHECK_EQUAL(events[0].link, scene.links[1]);
        silences += events[0].notice == IO_SILENT;
        losses += events[0].notice == IO_LOST;
        CHECK(silences + losses > 0);
        CHECK(scene.now_ns - asked_ns >= (silences + losses) * LINK_SILENCE_MS * MS);
    }
    CHECK_EQUAL(silences, 3);
    CHECK_EQUAL(scene.now_ns - asked_ns, usual.lost_after_ns);
    io_free(scene.bus);
}

static void a_full_ring_drops_what_is_oldest(void) {
    struct scene scene;
    static struct io_event events[IO_FRAMES_MAX + 1];
    begin(&scene);
    for (unsigned i = 0; i < 700; i++)
        number_comes(&scene, i);
    CHECK_EQUAL(io_take(scene.bus, events, 300), 300);
    for (unsigned i = 700; i < 1330; i++)
        number_comes(&scene, i);
    CHECK_EQUAL(io_take(scene.bus, events, IO_FRAMES_MAX + 1), IO_FRAMES_MAX);
    for (unsigned i = 0; i < IO_FRAMES_MAX; i++)
        CHECK_EQUAL(events[i].content[0] + 256 * events[i].content[1], i + 306);
    struct io_stats stats;
    io_get_stats(scene.bus, &stats);
    CHECK_EQUAL(stats.frames_dropped, 6);
    CHECK_EQUAL(stats.unclaimed_max, IO_FRAMES_MAX);
    CHECK_EQUAL(stats.frames_unclaimed, 1330);
    io_free(scene.bus);
}

// With room for eight, what is taken is of the kinds WANTED, and there is more.
static void check_kinds(struct scene *scene, const enum io_notice *wanted) {
    struct io_event events[8];
    CHECK_EQUAL(io_take(scene->bus, events, 8), 8);
    for (unsigned i = 0; i < 8; i++)
        CHECK_EQUAL(events[i].notice, wanted[i]);
    CHECK_EQUAL(scene->quiet, 0);
}

static void a_flood_lets_everything_else_through(void) {
    static const enum io_notice of_responses[] = {IO_FRAME, IO_RESPONSE, IO_RESPONSE, IO_RESPONSE,
                                                  IO_ENDED, IO_RESPONSE, IO_RESPONSE, IO_RESPONSE};
    static const enum io_notice of_frames[] = {IO_FRAME,    IO_FRAME, IO_FRAME, IO_FRAME,
                                               IO_RESPONSE, IO_ENDED, IO_FRAME, IO_FRAME};
    struct scene scene;
    begin(&scene);
    for (unsigned i = 0; i <= IO_RESPONSES_MAX / 2; i++)
        response_comes(&scene, 1);
    number_comes(&scene, 1);
    io_end(scene.bus, ENETDOWN);
    check_kinds(&scene, of_responses);
    io_free(scene.bus);
    begin(&scene);
    for (unsigned i = 0; i <= IO_FRAMES_MAX / 2; i++)
        number_comes(&scene, i);
    response_comes(&scene, 1);
    io_end(scene.bus, ENETDOWN);
    check_kinds(&scene, of_frames);
    io_free(scene.bus);
}

// However much comes in all, a ring that is emptied touches no more of its memory than waited at once.
static void a_ring_that_is_emptied_begins_again(void) {
    struct scene scene;
    struct io_event events[3];
    begin(&scene);
    for (unsigned i = 0; i < 2 * IO_FRAMES_MAX; i++) {
        number_comes(&scene, i);
        number_comes(&scene, i + 1);
        CHECK_EQUAL(io_take(scene.bus, events, 1), 1);
        CHECK_EQUAL(io_take(scene.bus, events + 1, 2), 1);
        CHECK_EQUAL(events[0].content[0], i % 256);
        CHECK_EQUAL(events[1].content[0], (i + 1) % 256);
    }
    CHECK(scene.bus->unclaimed.events[1].size);
    CHECK_EQUAL(scene.bus->unclaimed.events[2].size, 0);
    io_free(scene.bus);
}

// Of nothing older than what was handed over, though the round has not ended.
static void counters_keep_up_with_what_is_taken(void) {
    struct scene scene;
    struct io_stats stats;
    struct io_event event;
    begin(&scene);
    number_comes(&scene, 1);
    io_get_stats(scene.bus, &stats);
    CHECK_EQUAL(stats.frames_received, 0);
    CHECK_EQUAL(io_take(scene.bus, &event, 1), 1);
    io_get_stats(scene.bus, &stats);
    CHECK_EQUAL(stats.frames_received, 1);
    io_free(scene.bus);
}

// The link that is due first counts, wherever it is, and a timeout shows as soon as it is over.
static void time_acts_on_every_link(void) {
    for (unsigned first = 0; first < NODES; first++) {
        struct scene scene;
        struct io_link_stats stats;
        begin(&scene);
        uint64_t deadline_ns = scene.now_ns + 100 * MS;
        send_control(&scene, first);
        scene.now_ns += MS;
        for (unsigned i = 0; i < NODES; i++)
            if (i != first)
                send_control(&scene, i);
        CHECK_EQUAL(io_deadline(scene.bus, scene.now_ns), deadline_ns);
        io_handle_time(scene.bus, deadline_ns);
        for (unsigned i = 0; i < NODES; i++) {
            CHECK_EQUAL(io_get_link_stats(scene.bus, scene.links[i], &stats), IO_OK);
            CHECK_EQUAL(stats.link.timeouts, i == first);
        }
        io_free(scene.bus);
    }
}

// A driver whose line takes nothing does not ask for what it held back: it must not spin meanwhile.
static void what_was_held_back_is_due_once(void) {
    struct scene scene;
    uint8_t out[IO_OUT_FRAMES * FRAME];
    begin(&scene);
    io_set_bitrate(scene.bus, 1000000);
    scene.now_ns += 1000 * MS;
    CHECK_EQUAL(io_send_frame(scene.bus, OTHER_ID, out, 0), IO_OK);
    CHECK_EQUAL(io_next(scene.bus, scene.now_ns, 12, out, sizeof out), 0);
    uint64_t hold_ns = io_deadline(scene.bus, scene.now_ns);
    CHECK(hold_ns > scene.now_ns && hold_ns < scene.now_ns + 2 * MS);
    io_handle_time(scene.bus, hold_ns - 1);
    CHECK_EQUAL(io_deadline(scene.bus, hold_ns - 1), hold_ns);
    io_handle_time(scene.bus, hold_ns);
    CHECK_EQUAL(io_deadline(scene.bus, hold_ns), UINT64_MAX);
    io_free(scene.bus);
}

int main(void) {
    notices_come_in_order_whatever_room_there_is();
    a_drained_link_is_told_of_once_when_it_is();
    a_silent_node_is_told_of_again_and_again_until_it_is_lost();
    a_ring_that_is_emptied_begins_again();
    a_full_ring_drops_what_is_oldest();
    a_flood_lets_everything_else_through();
    counters_keep_up_with_what_is_taken();
    time_acts_on_every_link();
    what_was_held_back_is_due_once();
    return 0;
}
