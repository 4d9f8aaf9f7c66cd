// SPDX-License-Identifier: Apache-2.0
// sources: firmware/wire/*.c nodes/link/core/*.c nodes/link/io/*.c nodes/support/can_bits.c
// A bus without I/O, in virtual time: what it refuses, what it does with broken frames, and its end.
#include <errno.h>
#include <linux/can.h>
#include <string.h>

#include "nodes/link/io/io_api.h"
#include "tests/check.h"

enum { NODE = 4, TO_PYTHON_ID = 0x3F1 };

static const struct io_settings full_speed = {.bitrate = 1000000}, unknown_speed = {0};
static const struct link_settings usual = {.receive_window = 192, .lost_after_ns = 5000000000};

struct scene {
    uint64_t now_ns;
    int locks, notices;
};

static uint64_t now_of(void *context) {
    return ((struct scene *)context)->now_ns;
}

static void lock(void *context) {
    CHECK_EQUAL(((struct scene *)context)->locks++, 0);
}

static void unlock(void *context) {
    CHECK_EQUAL(--((struct scene *)context)->locks, 0);
}

static void kick(void *context) {
    CHECK_EQUAL(((struct scene *)context)->locks, 1);
}

static void notify(void *context) {
    ((struct scene *)context)->notices++;
}

static struct io_bus *bus_of(struct scene *scene, enum io_kind kind, const struct io_settings *settings) {
    static const struct io_driver driver = {now_of, lock, unlock, kick, notify, NULL};
    *scene = (struct scene){.now_ns = 1000000000};
    struct io_bus *bus = io_new(kind, settings, &driver, scene);
    CHECK(bus);
    return bus;
}

static void links_that_cannot_be_are_refused(void) {
    struct scene scene;
    const struct link_settings narrow = {.receive_window = LINK_WINDOW_MIN - 1, .lost_after_ns = 1},
                               never_lost = {.receive_window = 192};
    uint32_t number = 0, other = 0;
    struct io_bus *bus = bus_of(&scene, IO_CAN_STREAM, &full_speed);
    CHECK_EQUAL(io_open_link(bus, 256, &usual, &number), IO_INVALID);
    CHECK_EQUAL(io_open_link(bus, 0, &usual, &number), IO_INVALID);
    CHECK_EQUAL(io_open_link(bus, NODE, &narrow, &number), IO_INVALID);
    CHECK_EQUAL(io_open_link(bus, NODE, &never_lost, &number), IO_INVALID);
    CHECK_EQUAL(number, 0);
    CHECK_EQUAL(io_open_link(bus, NODE, &usual, &number), IO_OK);
    CHECK_EQUAL(io_open_link(bus, NODE, &usual, &other), IO_TAKEN);
    CHECK_EQUAL(io_open_link(bus, 255, &usual, &other), IO_OK);
    CHECK(number && other && number != other);
    CHECK_EQUAL(io_set_receive_window(bus, number, LINK_WINDOW_MIN - 1), IO_INVALID);
    CHECK_EQUAL(io_set_receive_window(bus, number, LINK_WINDOW_MIN), IO_OK);
    io_close_link(bus, number);
    CHECK_EQUAL(io_set_receive_window(bus, number, 192), IO_GONE);
    uint32_t again = 0;
    CHECK_EQUAL(io_open_link(bus, NODE, &usual, &again), IO_OK);
    CHECK(again != number && again != other); // a number is never used twice
    io_free(bus);

    bus = bus_of(&scene, IO_BYTES, &unknown_speed);
    CHECK_EQUAL(io_open_link(bus, NODE, &usual, &number), IO_INVALID);
    CHECK_EQUAL(io_open_link(bus, 0, &usual, &number), IO_OK);
    CHECK_EQUAL(io_open_link(bus, 0, &usual, &other), IO_TAKEN); // a serial line has one
    CHECK_EQUAL(io_send_frame(bus, TO_PYTHON_ID, (const uint8_t *)"", 0), IO_INVALID);
    io_free(bus);
}

static void broken_frames_are_counted_and_dropped(void) {
    struct scene scene;
    struct io_bus *bus = bus_of(&scene, IO_CAN_PACKET, &full_speed);
    const struct can_frame sound = {.can_id = TO_PYTHON_ID, .can_dlc = 3, .data = {1, 2, 3}};
    struct can_frame too_long = sound;
    too_long.can_dlc = CAN_MAX_DLEN + 1;
    io_received(bus, (const uint8_t *)&sound, sizeof(sound) - 1, scene.now_ns); // cut short
    io_received(bus, (const uint8_t *)&too_long, sizeof(too_long), scene.now_ns);
    io_received(bus, (const uint8_t *)&sound, sizeof(sound), scene.now_ns);
    io_handle_time(bus, scene.now_ns);
    struct io_event events[4];
    CHECK_EQUAL(scene.notices, 1);
    CHECK_EQUAL(io_take(bus, events, 4), 1);
    CHECK_EQUAL(events[0].notice, IO_FRAME);
    CHECK_EQUAL(events[0].can_id, TO_PYTHON_ID);
    CHECK(events[0].size == 3 && memcmp(events[0].content, sound.data, 3) == 0);
    struct io_stats stats;
    io_get_stats(bus, &stats);
    CHECK_EQUAL(stats.frames_malformed, 2);
    CHECK_EQUAL(stats.frames_unclaimed, 1);
    io_free(bus);
}

// A stream may be cut anywhere.
static void frames_in_pieces_are_put_together(void) {
    struct scene scene;
    struct io_bus *bus = bus_of(&scene, IO_CAN_STREAM, &full_speed);
    const struct can_frame frames[] = {{.can_id = 1, .can_dlc = 1}, {.can_id = 2, .can_dlc = 8}};
    const uint8_t *bytes = (const uint8_t *)frames;
    for (size_t cut = 0; cut <= sizeof(frames); cut++) {
        io_received(bus, bytes, cut, scene.now_ns);
        io_received(bus, bytes + cut, sizeof(frames) - cut, scene.now_ns);
        struct io_event events[4];
        CHECK_EQUAL(io_take(bus, events, 4), 2);
        CHECK(events[0].can_id == 1 && events[1].can_id == 2);
    }
    io_free(bus);
}

static void the_queue_of_frames_has_a_bound(void) {
    struct scene scene;
    struct io_bus *bus = bus_of(&scene, IO_CAN_STREAM, &full_speed);
    const uint8_t data[CAN_MAX_DLEN + 1] = {0};
    CHECK_EQUAL(io_send_frame(bus, TO_PYTHON_ID, data, sizeof(data)), IO_INVALID);
    for (int i = 0; i < IO_ADMIN_MAX; i++)
        CHECK_EQUAL(io_send_frame(bus, TO_PYTHON_ID, data, CAN_MAX_DLEN), IO_OK);
    CHECK_EQUAL(io_send_frame(bus, TO_PYTHON_ID, data, CAN_MAX_DLEN), IO_FULL);
    struct io_stats stats;
    io_get_stats(bus, &stats);
    CHECK_EQUAL(stats.admin_max, IO_ADMIN_MAX);
    io_free(bus);
}

// Only where the bit rate is known is there a budget; a new one begins when it becomes known.
static void the_bit_rate_may_become_known(void) {
    struct scene scene;
    struct io_bus *bus = bus_of(&scene, IO_CAN_STREAM, &unknown_speed);
    CHECK(!io_bounds_queue(bus));
    io_set_bitrate(bus, 250000);
    CHECK(io_bounds_queue(bus));
    const struct can_frame frame = {.can_id = TO_PYTHON_ID, .can_dlc = 8};
    io_received(bus, (const uint8_t *)&frame, sizeof(frame), scene.now_ns);
    io_set_bitrate(bus, 250000); // as before: what was counted stays
    io_handle_time(bus, scene.now_ns);
    struct io_stats stats;
    io_get_stats(bus, &stats);
    CHECK_EQUAL(stats.bitrate, 250000);
    CHECK(stats.received_bits >= 108 && stats.received_bits < 140);
    // A rate: what came within the first tenth of a second counts ten times.
    CHECK_EQUAL(stats.recent_bits[SCHEDULE_DATA] + stats.recent_bits[SCHEDULE_WEAK],
                10 * stats.received_bits);
    scene.now_ns += 1000000001; // nothing happened for more than a second, and nobody published that
    io_get_stats(bus, &stats);
    CHECK_EQUAL(stats.recent_bits[SCHEDULE_DATA] + stats.recent_bits[SCHEDULE_WEAK], 0);
    CHECK(stats.received_bits >= 108);
    io_free(bus);
}

static void an_ended_bus_takes_nothing_and_says_why(void) {
    struct scene scene;
    struct io_bus *bus = bus_of(&scene, IO_CAN_STREAM, &full_speed);
    uint32_t number = 0, other = 0;
    CHECK_EQUAL(io_open_link(bus, NODE, &usual, &number), IO_OK);
    io_end(bus, ENETDOWN);
    io_end(bus, EIO); // the first cause counts
    CHECK(io_ended(bus));
    CHECK_EQUAL(io_end_cause(bus), ENETDOWN);
    CHECK_EQUAL(io_deadline(bus, scene.now_ns), UINT64_MAX);
    CHECK_EQUAL(io_open_link(bus, NODE + 1, &usual, &other), IO_CLOSED);
    CHECK_EQUAL(io_send(bus, number, LINK_CONTROL, (const uint8_t *)"\5", 1, 0, 0), IO_CLOSED);
    CHECK_EQUAL(io_send_urgent(bus, number, (const uint8_t *)"\5", 1), IO_CLOSED);
    CHECK_EQUAL(io_send_frame(bus, TO_PYTHON_ID, (const uint8_t *)"", 0), IO_CLOSED);
    struct io_event events[4];
    CHECK_EQUAL(io_take(bus, events, 4), 1);
    CHECK_EQUAL(events[0].notice, IO_ENDED);
    CHECK_EQUAL(events[0].value, ENETDOWN);
    CHECK_EQUAL(io_take(bus, events, 4), 0);
    io_free(bus);
}

int main(void) {
    links_that_cannot_be_are_refused();
    broken_frames_are_counted_and_dropped();
    frames_in_pieces_are_put_together();
    the_queue_of_frames_has_a_bound();
    the_bit_rate_may_become_known();
    an_ended_bus_takes_nothing_and_says_why();
    return 0;
}
