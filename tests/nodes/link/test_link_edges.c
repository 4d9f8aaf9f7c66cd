// SPDX-License-Identifier: Apache-2.0
// sources: firmware/wire/*.c nodes/link/core/*.c nodes/link/io/*.c nodes/support/can_bits.c
// A bus and a node that answers when it is told to, in virtual time: to whom each byte belongs, what each
// counter says of it, and how many bytes may go at once.
#include "tests/nodes/link/bus_scene.h"

// ------------------------------------------------------------------------------------------------- receiving

static void an_answer_is_handed_over_with_its_times(enum io_kind kind, unsigned node) {
    struct scene scene;
    open(&scene, kind, node, &full_speed);
    run_up(&scene);
    struct io_event events[4];
    CHECK_EQUAL(io_take(scene.bus, events, 4), 0); // acknowledgements are nobody's business
    send_control(&scene, 2);
    uint64_t sent_ns = scene.now_ns;
    CHECK(pump(&scene, IO_OUT_FRAMES * FRAME) > 0);
    scene.now_ns += 3 * MS;
    const uint8_t content[] = {9, 8, 7, 6, 5, 4};
    answer(&scene, content, sizeof content);
    CHECK_EQUAL(io_take(scene.bus, events, 4), 1);
    CHECK_EQUAL(events[0].notice, IO_RESPONSE);
    CHECK_EQUAL(events[0].link, scene.link);
    CHECK_EQUAL(events[0].size, sizeof content);
    CHECK(memcmp(events[0].content, content, sizeof content) == 0);
    CHECK_EQUAL(events[0].sent_ns, sent_ns);
    CHECK_EQUAL(events[0].received_ns, scene.now_ns);
    CHECK_EQUAL(link_stats(&scene).link.blocks_received, 4);
    CHECK_EQUAL(link_stats(&scene).link.bytes_received, 3 * 5 + 11);
    CHECK_EQUAL(bus_stats(&scene).responses_max, 1);
    io_free(scene.bus);
}

// Acknowledgements are counted apart: they are part of what motion costs.
static void what_comes_is_counted(void) {
    struct scene scene;
    open(&scene, IO_CAN_STREAM, NODE, &full_speed);
    run_up(&scene);
    scene.now_ns += 5000 * MS; // what was before is older than a second
    struct io_stats before = bus_stats(&scene);
    struct io_flow received = link_stats(&scene).received;
    CHECK_EQUAL(received.frames, 3);
    uint8_t ack[8] = {0}, other[8] = {0};
    CHECK_EQUAL(wire_block_finish(ack, 0, scene.expected), WIRE_BLOCK_MIN);
    frame_comes(&scene, id_of(NODE) + 1u, ack, WIRE_BLOCK_MIN);
    uint64_t ack_bits = can_frame_bits(id_of(NODE) + 1u, WIRE_BLOCK_MIN, ack);
    other[0] = WIRE_BLOCK_MIN; // as long as an acknowledgement by its first byte, but not by itself
    frame_comes(&scene, id_of(NODE) + 1u, other, 8);
    uint64_t data_bits = can_frame_bits(id_of(NODE) + 1u, 8, other);
    other[0] = 6; // and by itself, but not by its first byte
    other[1] = WIRE_BLOCK_MIN;
    frame_comes(&scene, id_of(NODE) + 1u, other, WIRE_BLOCK_MIN);
    data_bits += can_frame_bits(id_of(NODE) + 1u, WIRE_BLOCK_MIN, other);
    struct io_stats after = bus_stats(&scene);
    CHECK_EQUAL(after.frames_received - before.frames_received, 3);
    CHECK_EQUAL(after.bytes_received - before.bytes_received, 3 * FRAME);
    CHECK_EQUAL(after.received_bits - before.received_bits, ack_bits + data_bits);
    CHECK_EQUAL(after.frames_unclaimed, 0);
    CHECK_EQUAL(link_stats(&scene).received.frames - received.frames, 3);
    CHECK_EQUAL(link_stats(&scene).received.bits - received.bits, ack_bits + data_bits);
    // The window is a second and what the slot that is being filled has of its tenth.
    uint64_t span_us = 1000000 + scene.now_ns % (100 * MS) / 1000;
    CHECK_EQUAL(after.recent_bits[SCHEDULE_ACKS], ack_bits * 1000000 / span_us);
    CHECK_EQUAL(after.recent_bits[SCHEDULE_DATA], data_bits * 1000000 / span_us);
    CHECK_EQUAL(after.recent_bits[SCHEDULE_WEAK], 0);
    io_free(scene.bus);
}

static void frames_belong_to_links_by_their_ids(void) {
    struct scene scene;
    uint32_t last;
    const uint8_t data[8] = {1, 2, 3};
    open(&scene, IO_CAN_STREAM, NODE, &full_speed);
    CHECK_EQUAL(io_open_link(scene.bus, LAST_NODE, &usual, &last), IO_OK);
    const uint32_t others[] = {0,
                               1,
                               DATA_ID - 1,
                               DATA_ID,
                               DATA_ID + 1u,
                               DATA_ID + 2u * NODE,
                               DATA_ID + 2u * NODE - 1,
                               DATA_ID + 2u * NODE + 3,
                               DATA_ID + 2u * LAST_NODE,
                               DATA_ID + 2u * 256 + 1,
                               TO_PYTHON_ID,
                               TO_PYTHON_ID + 1,
                               0x7FF};
    enum { OTHERS = sizeof others / sizeof *others };
    for (size_t i = 0; i < OTHERS; i++) {
        struct io_event event;
        scene.now_ns += MS;
        frame_comes(&scene, others[i], data, 3);
        CHECK_EQUAL(bus_stats(&scene).frames_unclaimed, i + 1);
        CHECK_EQUAL(io_take(scene.bus, &event, 1), 1);
        CHECK_EQUAL(event.notice, IO_FRAME);
        CHECK_EQUAL(event.can_id, others[i]);
        CHECK_EQUAL(event.received_ns, scene.now_ns);
        CHECK(event.size == 3 && memcmp(event.content, data, 3) == 0);
    }
    frame_comes(&scene, DATA_ID + 2u * NODE + 1, data, 3);
    frame_comes(&scene, DATA_ID + 2u * LAST_NODE + 1, data, 3);
    CHECK_EQUAL(bus_stats(&scene).frames_unclaimed, OTHERS);
    CHECK_EQUAL(link_stats(&scene).link.bytes_received, 3);
    scene.link = last;
    CHECK_EQUAL(link_stats(&scene).link.bytes_received, 3);
    CHECK_EQUAL(bus_stats(&scene).frames_received, OTHERS + 2);
    io_free(scene.bus);
}

// Ids above all of ours give way to us.
static void frames_of_the_weakest_ids_count_apart(void) {
    struct scene scene;
    const uint8_t data[8] = {0};
    open(&scene, IO_CAN_STREAM, NODE, &full_speed);
    frame_comes(&scene, TO_PYTHON_ID, data, 2);
    CHECK_EQUAL(bus_stats(&scene).recent_bits[SCHEDULE_WEAK], 0);
    CHECK_EQUAL(bus_stats(&scene).recent_bits[SCHEDULE_DATA], 10 * can_frame_bits(TO_PYTHON_ID, 2, data));
    frame_comes(&scene, TO_PYTHON_ID + 1, data, 2);
    CHECK_EQUAL(bus_stats(&scene).recent_bits[SCHEDULE_WEAK], 10 * can_frame_bits(TO_PYTHON_ID + 1, 2, data));
    CHECK_EQUAL(bus_stats(&scene).recent_bits[SCHEDULE_DATA], 10 * can_frame_bits(TO_PYTHON_ID, 2, data));
    io_free(scene.bus);
}

// Also when nothing was done on the bus for long before, and for the least that can come.
static void a_single_byte_counts_when_it_comes(void) {
    struct scene scene;
    const uint8_t data[8] = {1};
    open(&scene, IO_CAN_STREAM, NODE, &full_speed);
    CHECK_EQUAL(bus_stats(&scene).received_bits, 0);
    scene.now_ns += 5000 * MS + 50 * MS;
    frame_comes(&scene, id_of(NODE) + 1u, data, 1);
    uint64_t bits = can_frame_bits(id_of(NODE) + 1u, 1, data);
    CHECK_EQUAL(bus_stats(&scene).recent_bits[SCHEDULE_DATA], bits * 1000000 / 1050000);
    CHECK_EQUAL(link_stats(&scene).link.bytes_received, 1);
    CHECK_EQUAL(link_stats(&scene).received.frames, 1);
    CHECK_EQUAL(link_stats(&scene).received.bits, bits);
    io_free(scene.bus);
}

// A block that is cut off is given up by time alone, and the counters of the link say so.
static void what_time_gives_up_is_counted(void) {
    struct scene scene;
    const uint8_t cut_off[] = {20, WIRE_SEQ_MARK, 1};
    open(&scene, IO_CAN_STREAM, NODE, &full_speed);
    frame_comes(&scene, id_of(NODE) + 1u, cut_off, sizeof cut_off);
    bus_stats(&scene);
    CHECK_EQUAL(io_deadline(scene.bus, scene.now_ns), scene.now_ns + 100 * MS);
    scene.now_ns += 100 * MS - 1;
    io_handle_time(scene.bus, scene.now_ns);
    bus_stats(&scene);
    CHECK_EQUAL(link_stats(&scene).link.bytes_invalid, 0);
    scene.now_ns++;
    io_handle_time(scene.bus, scene.now_ns);
    bus_stats(&scene);
    CHECK_EQUAL(link_stats(&scene).link.bytes_received, sizeof cut_off);
    CHECK_EQUAL(link_stats(&scene).link.bytes_invalid, sizeof cut_off);
    io_free(scene.bus);
}

static void a_stream_may_come_byte_by_byte(void) {
    struct scene scene;
    open(&scene, IO_CAN_STREAM, NODE, &full_speed);
    struct can_frame frames[3];
    memset(frames, 0, sizeof frames);
    for (unsigned i = 0; i < 3; i++) {
        frames[i].can_id = TO_PYTHON_ID + i;
        frames[i].can_dlc = 8;
        memset(frames[i].data, (int)(0x11 * (i + 1)), 8);
    }
    struct io_event events[4];
    for (size_t piece = 1; piece <= sizeof frames; piece++) {
        for (size_t at = 0; at < sizeof frames; at += piece) {
            size_t size = sizeof frames - at < piece ? sizeof frames - at : piece;
            uint8_t exact[sizeof frames];
            memcpy(exact, (const uint8_t *)frames + at, size);
            memset(exact + size, 0xEE, sizeof exact - size); // what is behind it is none of it
            io_received(scene.bus, exact, size, scene.now_ns);
        }
        CHECK_EQUAL(io_take(scene.bus, events, 4), 3);
        for (unsigned i = 0; i < 3; i++) {
            CHECK_EQUAL(events[i].can_id, TO_PYTHON_ID + i);
            CHECK(memcmp(events[i].content, frames[i].data, 8) == 0);
        }
    }
    CHECK_EQUAL(bus_stats(&scene).frames_malformed, 0);
    io_free(scene.bus);
}

static void a_serial_line_counts_bytes(void) {
    struct scene scene;
    static const struct io_settings slow = {.bitrate = 250000};
    open(&scene, IO_BYTES, 0, &slow);
    const uint8_t data[] = {1, 2, 3};
    io_received(scene.bus, data, sizeof data, scene.now_ns);
    CHECK_EQUAL(link_stats(&scene).link.bytes_received, 0); // counters are published at the end of a round
    struct io_stats stats = bus_stats(&scene);
    CHECK_EQUAL(link_stats(&scene).link.bytes_received, 3);
    CHECK_EQUAL(stats.bytes_received, 3);
    CHECK_EQUAL(stats.received_bits, 30);
    CHECK_EQUAL(stats.recent_bits[SCHEDULE_DATA], 300);
    io_close_link(scene.bus, scene.link);
    io_received(scene.bus, data, sizeof data, scene.now_ns); // nobody's
    CHECK_EQUAL(bus_stats(&scene).bytes_received, 6);
    io_free(scene.bus);
}

// --------------------------------------------------------------------------------------------------- sending

static void what_goes_is_counted(void) {
    struct scene scene;
    open(&scene, IO_CAN_STREAM, NODE, &full_speed);
    run_up(&scene);
    struct io_stats before = bus_stats(&scene);
    struct io_flow flow = link_stats(&scene).flows[LINK_CONTROL];
    send_control(&scene, 14); // 19 bytes on the wire: 8 + 8 + 3
    CHECK_EQUAL(pump(&scene, IO_OUT_FRAMES * FRAME), 3);
    struct io_stats after = bus_stats(&scene);
    CHECK_EQUAL(after.frames_sent - before.frames_sent, 3);
    CHECK_EQUAL(after.bytes_sent - before.bytes_sent, 3 * FRAME);
    uint64_t bits = after.sent_bits[LINK_CONTROL] - before.sent_bits[LINK_CONTROL];
    CHECK(bits >= 3 * 47 + 19 * 8 && bits <= 3 * 47 + 19 * 8 + 3 * 24);
    struct io_flow now = link_stats(&scene).flows[LINK_CONTROL];
    CHECK_EQUAL(now.frames - flow.frames, 3);
    CHECK_EQUAL(now.bits - flow.bits, bits);
    CHECK_EQUAL(now.blocks - flow.blocks, 1);
    CHECK_EQUAL(link_stats(&scene).flows[LINK_MOTION].frames, 0);
    io_free(scene.bus);
}

// A block that fills its last frame ends there; the one behind it shares the last frame of one that does not.
static void blocks_are_cut_into_frames(void) {
    struct scene scene;
    open(&scene, IO_CAN_STREAM, NODE, &full_speed);
    run_up(&scene);
    for (size_t size = 1; size <= WIRE_CONTENT_MAX; size++) {
        unsigned blocks = scene.blocks;
        send_control(&scene, size);
        CHECK_EQUAL(pump(&scene, FRAME), (size + WIRE_BLOCK_MIN + 7) / 8); // with room for one at a time
        CHECK_EQUAL(scene.blocks, blocks + 1);
        scene.now_ns += 10 * MS;
        answer(&scene, NULL, 0);
    }
    io_free(scene.bus);
}

// Two blocks of 41 bytes: 82 bytes in 11 frames, where each by itself would take 6.
static void a_frame_holds_the_end_of_one_block_and_the_start_of_the_next(void) {
    struct scene scene;
    open(&scene, IO_CAN_STREAM, NODE, &full_speed);
    run_up(&scene);
    for (size_t room = 1; room <= IO_OUT_FRAMES; room++) {
        unsigned blocks = scene.blocks;
        send_control(&scene, 36);
        send_control(&scene, 36);
        CHECK_EQUAL(pump(&scene, room * FRAME), 11);
        CHECK_EQUAL(scene.blocks, blocks + 2);
        scene.now_ns += 10 * MS;
        answer(&scene, NULL, 0);
        CHECK_EQUAL(link_stats(&scene).pending, 0);
    }
    io_free(scene.bus);
}

// Among links that are due alike the turn goes round.
static void links_take_turns(void) {
    struct scene one;
    open(&one, IO_CAN_STREAM, NODE, &full_speed);
    uint32_t links[3] = {one.link};
    for (unsigned i = 1; i < 3; i++)
        CHECK_EQUAL(io_open_link(one.bus, NODE + i, &usual, &links[i]), IO_OK);
    for (unsigned i = 0; i < 3; i++)
        CHECK_EQUAL(io_send(one.bus, links[i], LINK_CONTROL, (const uint8_t *)"\5", 1, 0, 0), IO_OK);
    uint8_t out[IO_OUT_FRAMES * FRAME];
    for (unsigned i = 0; i < 3; i++) { // first contact: 64 bytes, so 8 frames, to each
        CHECK_EQUAL(io_next(one.bus, one.now_ns, 0, out, 8 * FRAME), 8 * FRAME);
        for (size_t at = 0; at < 8 * FRAME; at += FRAME)
            CHECK_EQUAL(out[at], id_of(NODE + i) % 256);
        one.now_ns += MS;
    }
    CHECK_EQUAL(io_next(one.bus, one.now_ns, 0, out, 8 * FRAME), 0);
    io_free(one.bus);
}

static void admin_frames_go_first_and_within_the_room(void) {
    struct scene scene;
    open(&scene, IO_CAN_STREAM, NODE, &full_speed);
    for (uint8_t i = 0; i < 5; i++)
        CHECK_EQUAL(io_send_frame(scene.bus, TO_PYTHON_ID - 1u, &i, 1), IO_OK);
    send_control(&scene, 1);
    uint8_t out[IO_OUT_FRAMES * FRAME];
    CHECK_EQUAL(io_next(scene.bus, scene.now_ns, 0, out, 3 * FRAME), 3 * FRAME);
    for (uint8_t i = 0; i < 3; i++)
        CHECK(out[i * FRAME] == (TO_PYTHON_ID - 1) % 256 && out[i * FRAME + 8] == i);
    CHECK_EQUAL(io_next(scene.bus, scene.now_ns, 0, out, 3 * FRAME), 3 * FRAME);
    CHECK_EQUAL(out[2 * FRAME], id_of(NODE) % 256); // and then data
    io_free(scene.bus);
}

// The kernel's queue takes what the bit rate allows within 1.5 ms: 12 frames at 1 Mbit/s.
static void the_kernels_queue_is_filled_and_no_more(void) {
    struct scene scene;
    open(&scene, IO_CAN_STREAM, NODE, &full_speed);
    const uint8_t data[8] = {0};
    for (int i = 0; i < 20; i++)
        CHECK_EQUAL(io_send_frame(scene.bus, TO_PYTHON_ID - 1u, data, 8), IO_OK);
    uint8_t out[IO_OUT_FRAMES * FRAME];
    CHECK_EQUAL(io_next(scene.bus, scene.now_ns, 9, out, sizeof out), 3 * FRAME);
    CHECK_EQUAL(io_next(scene.bus, scene.now_ns, 12, out, sizeof out), 0);
    CHECK(io_deadline(scene.bus, scene.now_ns) > scene.now_ns);
    CHECK_EQUAL(io_deadline(scene.bus, scene.now_ns), scene.now_ns + 9 * 120 * 1000); // all but 3
    struct io_stats stats;
    io_get_stats(scene.bus, &stats);
    CHECK_EQUAL(stats.queued_max, 12);
    CHECK_EQUAL(stats.queue_waits, 1);
    io_free(scene.bus);
}

// A block that is longer than the room uses all of it up.
static void a_serial_lines_queue_is_bounded_when_asked_for(void) {
    struct scene scene;
    static const struct io_settings bounded = {.bitrate = 250000, .queue_frames = 20};
    open(&scene, IO_BYTES, 0, &bounded);
    run_up(&scene);
    send_control(&scene, 30); // 35 bytes
    uint8_t out[IO_OUT_FRAMES * FRAME];
    CHECK_EQUAL(io_next(scene.bus, scene.now_ns, 0, out, sizeof out), 35);
    struct io_stats stats = bus_stats(&scene);
    CHECK_EQUAL(stats.queued_max, 20);
    send_control(&scene, 30);
    CHECK_EQUAL(io_next(scene.bus, scene.now_ns, 20, out, sizeof out), 0);
    io_get_stats(scene.bus, &stats);
    CHECK(stats.queue_waits >= 1);
    scene.now_ns += 5 * MS;
    CHECK_EQUAL(io_next(scene.bus, scene.now_ns, 19, out, sizeof out), 35);
    io_free(scene.bus);
}

// Whichever link waits for its acknowledgement for 7 ms: the line is left alone for the length of a frame.
static void an_acknowledgement_that_does_not_come_makes_a_pause(void) {
    for (unsigned silent = 0; silent < 2; silent++) {
        struct scene scene;
        open(&scene, IO_CAN_STREAM, NODE, &full_speed);
        uint32_t links[2] = {scene.link};
        CHECK_EQUAL(io_open_link(scene.bus, NODE + 1, &usual, &links[1]), IO_OK);
        CHECK_EQUAL(io_send(scene.bus, links[silent], LINK_CONTROL, (const uint8_t *)"\5", 1, 0, 0), IO_OK);
        uint8_t out[IO_OUT_FRAMES * FRAME], data = 0;
        CHECK_EQUAL(io_next(scene.bus, scene.now_ns, 0, out, sizeof out), 8 * FRAME);
        CHECK_EQUAL(io_next(scene.bus, scene.now_ns, 0, out, sizeof out), 0);
        CHECK_EQUAL(bus_stats(&scene).queued_max, 8);
        scene.now_ns += 7 * MS - 1;
        CHECK_EQUAL(io_send_frame(scene.bus, TO_PYTHON_ID, &data, 1), IO_OK);
        CHECK_EQUAL(io_next(scene.bus, scene.now_ns, 0, out, sizeof out), FRAME);
        CHECK_EQUAL(io_next(scene.bus, scene.now_ns, 0, out, sizeof out), 0);
        scene.now_ns += MS;
        CHECK_EQUAL(io_send_frame(scene.bus, TO_PYTHON_ID, &data, 1), IO_OK);
        CHECK_EQUAL(io_next(scene.bus, scene.now_ns, 0, out, sizeof out), 0);
        CHECK_EQUAL(io_deadline(scene.bus, scene.now_ns), scene.now_ns + 120000);
        CHECK_EQUAL(bus_stats(&scene).queued_max, 8); // that nothing may go says nothing of the queue
        scene.now_ns += 120000;
        CHECK_EQUAL(io_next(scene.bus, scene.now_ns, 0, out, sizeof out), FRAME);
        io_free(scene.bus);
    }
}

// What was queued before does not go, and a line that is not bounded has no figure of its queue.
static void an_ended_bus_sends_nothing(void) {
    struct scene scene;
    static const struct io_settings unknown = {0};
    open(&scene, IO_CAN_STREAM, NODE, &unknown);
    uint8_t out[IO_OUT_FRAMES * FRAME], data = 0;
    for (int i = 0; i < 2; i++)
        CHECK_EQUAL(io_send_frame(scene.bus, TO_PYTHON_ID, &data, 1), IO_OK);
    CHECK_EQUAL(io_next(scene.bus, scene.now_ns, 0, out, FRAME), FRAME);
    io_end(scene.bus, 0);
    CHECK_EQUAL(io_next(scene.bus, scene.now_ns, 0, out, FRAME), 0);
    struct io_stats stats;
    io_get_stats(scene.bus, &stats);
    CHECK_EQUAL(stats.queued_max, 0);
    io_free(scene.bus);
}

int main(void) {
    an_acknowledgement_that_does_not_come_makes_a_pause();
    an_ended_bus_sends_nothing();
    an_answer_is_handed_over_with_its_times(IO_CAN_STREAM, NODE);
    an_answer_is_handed_over_with_its_times(IO_CAN_PACKET, LAST_NODE);
    an_answer_is_handed_over_with_its_times(IO_BYTES, 0);
    what_comes_is_counted();
    frames_belong_to_links_by_their_ids();
    frames_of_the_weakest_ids_count_apart();
    a_single_byte_counts_when_it_comes();
    what_time_gives_up_is_counted();
    a_stream_may_come_byte_by_byte();
    a_serial_line_counts_bytes();
    what_goes_is_counted();
    blocks_are_cut_into_frames();
    a_frame_holds_the_end_of_one_block_and_the_start_of_the_next();
    links_take_turns();
    admin_frames_go_first_and_within_the_room();
    the_kernels_queue_is_filled_and_no_more();
    a_serial_lines_queue_is_bounded_when_asked_for();
    return 0;
}
