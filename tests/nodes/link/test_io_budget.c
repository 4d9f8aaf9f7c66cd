// SPDX-License-Identifier: Apache-2.0
// sources: firmware/wire/*.c nodes/link/core/*.c nodes/link/io/*.c nodes/support/can_bits.c
// What a bus lets go at once, what it holds back and until when, and to which class each bit is counted: to
// the bit and the nanosecond.
#include "nodes/link/core/batch.h"
#include "tests/nodes/link/bus_scene.h"

enum {
    ROOM = IO_OUT_FRAMES * FRAME,
    FULL_BLOCK_FRAMES = WIRE_BLOCK_MAX / 8,
    LEARNED_BYTES = 4096, // of motion, until its measured cost is trusted
};

static const struct io_settings slow = {.bitrate = 125000, .queue_frames = 100}, unknown_speed = {0};

static void send_of(struct scene *scene, enum link_class kind, size_t size) {
    static const uint8_t content[WIRE_CONTENT_MAX] = {5};
    CHECK_EQUAL(io_send(scene->bus, scene->link, kind, content, size, 0, 0), IO_OK);
}

// What goes in one round of ROOM bytes.
static size_t one_round(struct scene *scene, size_t room, uint64_t queued) {
    uint8_t out[ROOM];
    size_t size = io_next(scene->bus, scene->now_ns, queued, out, room);
    CHECK(size <= room);
    for (size_t at = 0; scene->kind != IO_BYTES && at < size; at += FRAME) {
        struct can_frame frame;
        memcpy(&frame, out + at, FRAME);
        if (frame.can_id == id_of(scene->node))
            node_hears(scene, frame.data, frame.can_dlc);
    }
    if (scene->kind == IO_BYTES)
        node_hears(scene, out, size);
    return size;
}

static uint64_t sent_bits(struct scene *scene, enum link_class kind) {
    return bus_stats(scene).sent_bits[kind];
}

static void check_deadline(struct scene *scene, uint64_t from_now_ns) {
    CHECK_EQUAL(io_deadline(scene->bus, scene->now_ns) - scene->now_ns, from_now_ns);
}

// ----------------------------------------------------------------------------------------------- serial line

static void a_serial_lines_bytes_are_counted_as_they_go(void) {
    struct scene scene;
    static const struct io_settings line = {.bitrate = 250000};
    open(&scene, IO_BYTES, 0, &line);
    run_up(&scene);
    uint64_t before = sent_bits(&scene, LINK_BULK);
    send_of(&scene, LINK_BULK, 30);
    CHECK_EQUAL(one_round(&scene, ROOM, 0), 35);
    CHECK_EQUAL(sent_bits(&scene, LINK_BULK) - before, 350);
    struct io_flow flow = link_stats(&scene).flows[LINK_BULK];
    CHECK(flow.bits == 350 && flow.blocks == 1 && flow.frames == 0); // a serial line has no frames
    io_free(scene.bus);
}

// A block needs room for the longest that there can be.
static void a_serial_lines_blocks_go_as_far_as_there_is_room(void) {
    static const struct {
        size_t room, first, second;
    } cases[] = {{LINK_WIRE_MAX, 45, 35},
                 {LINK_WIRE_MAX + 44, 45, 35},
                 {LINK_WIRE_MAX + 45, 80, 0},
                 {LINK_WIRE_MAX + 46, 80, 0}};
    for (size_t i = 0; i < sizeof cases / sizeof *cases; i++) {
        struct scene scene;
        open(&scene, IO_BYTES, 0, &unknown_speed);
        run_up(&scene);
        send_of(&scene, LINK_CONTROL, 40); // a block has no room for both
        send_of(&scene, LINK_CONTROL, 30);
        CHECK_EQUAL(one_round(&scene, cases[i].room, 0), cases[i].first);
        CHECK_EQUAL(one_round(&scene, cases[i].room, 0), cases[i].second);
        CHECK_EQUAL(one_round(&scene, cases[i].room, 0), 0);
        CHECK_EQUAL(bus_stats(&scene).queued_max, 0);                // not bounded
        CHECK_EQUAL(link_stats(&scene).flows[LINK_CONTROL].bits, 0); // the bit rate is unknown
        io_free(scene.bus);
    }
}

// What goes uses the room in the queue up; a byte of it is enough for a block.
static void a_serial_lines_queue_fills_block_by_block(void) {
    static const struct {
        uint64_t queued;
        size_t goes;
    } cases[] = {{0, 80}, {14, 80}, {15, 45}, {59, 45}, {60, 0}, {61, 0}};
    for (size_t i = 0; i < sizeof cases / sizeof *cases; i++) {
        struct scene scene;
        static const struct io_settings line = {.bitrate = 250000, .queue_frames = 60};
        open(&scene, IO_BYTES, 0, &line);
        run_up(&scene);
        for (int k = 0; k < 3; k++)
            send_of(&scene, LINK_CONTROL, k == 1 ? 30 : 40);
        scene.now_ns += 100 * MS;
        CHECK_EQUAL(one_round(&scene, ROOM, cases[i].queued), cases[i].goes);
        io_free(scene.bus);
    }
}

// ---------------------------------------------------------------------------------------------------- budget

// Bulk goes while there is credit, at most a full block's worth (1215 bits); a second block overdraws it, and
// a third waits until nine tenths of the bit rate have paid for that.
static void the_budget_holds_bulk_back_until_it_is_paid(void) {
    struct scene scene;
    static const struct link_settings wide = {.receive_window = 1024, .lost_after_ns = 60000 * MS};
    open(&scene, IO_CAN_STREAM, NODE, &slow);
    io_close_link(scene.bus, scene.link);
    CHECK_EQUAL(io_open_link(scene.bus, NODE, &wide, &scene.link), IO_OK);
    CHECK_EQUAL(io_deadline(scene.bus, scene.now_ns), UINT64_MAX);
    run_up(&scene);
    scene.now_ns += 1000 * MS;
    uint64_t before = sent_bits(&scene, LINK_BULK);
    CHECK_EQUAL(bus_stats(&scene).held_ns, 0);
    for (int i = 0; i < 3; i++)
        send_of(&scene, LINK_BULK, WIRE_CONTENT_MAX);
    size_t frames = 0;
    for (size_t size; (size = one_round(&scene, ROOM, 0)) > 0; frames += size / FRAME)
        ;
    CHECK_EQUAL(frames, 2 * FULL_BLOCK_FRAMES);
    uint64_t owed = sent_bits(&scene, LINK_BULK) - before - 1215;
    uint64_t opens_ns = owed * 8000 * 10 / 9 + 1; // a bit lasts 8 us
    check_deadline(&scene, opens_ns);
    CHECK_EQUAL(bus_stats(&scene).queue_waits, 0);
    scene.now_ns += opens_ns - 2; // one may be lost by rounding
    CHECK_EQUAL(one_round(&scene, ROOM, 0), 0);
    scene.now_ns += 2;
    io_handle_time(scene.bus, scene.now_ns);
    CHECK_EQUAL(one_round(&scene, ROOM, 0), FULL_BLOCK_FRAMES * FRAME);
    CHECK_EQUAL(one_round(&scene, ROOM, 0), 0);
    CHECK_EQUAL(bus_stats(&scene).held_ns, opens_ns);
    scene.now_ns += 10; // nothing is held any more
    CHECK_EQUAL(bus_stats(&scene).held_ns, opens_ns);
    io_free(scene.bus);
}

// Where the kernel's queue is full, too, the sooner of both is waited for, and is to blame. Received frames
// have used up all the credit that there can be, 50 ms: motion may be sent ahead again in 30 ms.
static void a_full_queue_and_a_spent_budget_wait_for_the_sooner(void) {
    static const struct io_settings settings = {.bitrate = 125000, .queue_frames = 34, .ceiling = 1.0};
    const uint64_t queue_ns = 31 * 960000,
                   budget_ns = 30 * MS + 1; // all but 3 of the queue; all bits are given out
    for (uint64_t later_ns = budget_ns - queue_ns - 1; later_ns <= budget_ns - queue_ns + 1; later_ns++) {
        struct scene scene;
        const uint8_t data[8] = {0};
        open(&scene, IO_CAN_STREAM, NODE, &settings);
        run_up(&scene);
        scene.now_ns += 1000 * MS;
        send_of(&scene, LINK_BULK, WIRE_CONTENT_MAX); // bulk's own share is used up
        CHECK_EQUAL(one_round(&scene, ROOM, 0), FULL_BLOCK_FRAMES * FRAME);
        answer(&scene, NULL, 0);
        for (int i = 0; i < 100; i++)
            frame_comes(&scene, TO_PYTHON_ID, data, 8);
        send_of(&scene, LINK_BULK, 1);
        send_of(&scene, LINK_CONTROL, 1); // of which a block may go at any time
        scene.now_ns += later_ns;
        CHECK_EQUAL(one_round(&scene, ROOM, 34), 0);
        int by_budget = budget_ns - later_ns < queue_ns;
        check_deadline(&scene, by_budget ? budget_ns - later_ns : queue_ns);
        struct io_stats stats;
        io_get_stats(scene.bus, &stats);
        CHECK_EQUAL(stats.queue_waits, 1);
        scene.now_ns += 1000;
        CHECK_EQUAL(bus_stats(&scene).held_ns, by_budget ? 1000 : 0);
        io_free(scene.bus);
    }
}

// What waits for the queue alone: until 3 frames are left. Nothing waits: for nothing.
static void a_full_queue_is_waited_for_only_with_something_to_send(void) {
    struct scene scene;
    uint8_t data = 0;
    open(&scene, IO_CAN_STREAM, NODE, &full_speed);
    scene.now_ns += 1000 * MS; // the budget holds nothing back
    CHECK_EQUAL(one_round(&scene, ROOM, 12), 0);
    check_deadline(&scene, UINT64_MAX - scene.now_ns);
    CHECK_EQUAL(bus_stats(&scene).queue_waits, 0);
    CHECK_EQUAL(io_send_frame(scene.bus, TO_PYTHON_ID, &data, 1), IO_OK);
    CHECK_EQUAL(one_round(&scene, ROOM, 12), 0);
    check_deadline(&scene, 9 * 120000);
    CHECK_EQUAL(one_round(&scene, ROOM, 11), FRAME); // sooner than it was to be
    CHECK_EQUAL(one_round(&scene, ROOM, 12), 0);
    check_deadline(&scene, UINT64_MAX - scene.now_ns); // that wait is over
    CHECK_EQUAL(bus_stats(&scene).queue_waits, 1);
    send_of(&scene, LINK_CONTROL, 1);
    CHECK_EQUAL(one_round(&scene, ROOM, 12), 0);
    check_deadline(&scene, 9 * 120000);
    CHECK_EQUAL(bus_stats(&scene).queue_waits, 2);
    io_free(scene.bus);
}

// What waits in the kernel is an estimate from a bit rate that a node reports: a stop goes whatever that
// says, and before the frames that were queued first.
static void a_stop_waits_neither_for_the_queue_nor_for_other_frames(void) {
    struct scene scene;
    static const uint8_t stop[6] = {0};
    uint8_t out[ROOM];
    open(&scene, IO_CAN_STREAM, NODE, &full_speed);
    scene.now_ns += 1000 * MS;
    send_of(&scene, LINK_CONTROL, 1);
    for (unsigned can_id = DATA_ID; can_id < DATA_ID + 2; can_id++)
        CHECK_EQUAL(io_send_frame(scene.bus, can_id, stop, 1), IO_OK);
    CHECK_EQUAL(one_round(&scene, ROOM, 12), 0);
    for (int i = 0; i < 3; i++)
        CHECK_EQUAL(io_send_frame(scene.bus, DATA_ID - 1, stop, sizeof stop), IO_OK);
    CHECK_EQUAL(one_round(&scene, 3 * FRAME - 1, 12), 2 * FRAME);
    CHECK_EQUAL(one_round(&scene, ROOM, 12), FRAME); // and nothing with it
    CHECK_EQUAL(one_round(&scene, ROOM, 12), 0);
    check_deadline(&scene, 9 * 120000);
    CHECK_EQUAL(io_send_frame(scene.bus, DATA_ID - 1, stop, sizeof stop), IO_OK);
    CHECK_EQUAL(io_next(scene.bus, scene.now_ns, 10, out, sizeof out), 2 * FRAME); // it takes room
    CHECK(out[0] == 0xFF && out[1] == 0x00);
    CHECK(out[FRAME] == 0x00 && out[FRAME + 1] == 0x01); // the first of the others
    io_free(scene.bus);
}

// -------------------------------------------------------------------------------------------------- reading

static void send_motion(struct scene *scene, int count) {
    static const uint8_t content[WIRE_CONTENT_MAX] = {4};
    uint8_t batch[BATCH_HEADER + WIRE_CONTENT_MAX];
    size_t size = batch_write(batch, 0, 0, content, WIRE_CONTENT_MAX);
    for (int i = 0; i < count; i++)
        CHECK_EQUAL(io_send_batch(scene->bus, scene->link, batch, size), IO_OK);
}

static int may_stay_unread(struct scene *scene) {
    return io_may_stay_unread(scene->bus, scene->now_ns);
}

// The kernel's queue is full: until 3 of its 12 frames are left, some 1.1 ms.
static void acknowledgements_of_motion_wait_until_more_can_be_sent(void) {
    struct scene scene;
    uint8_t data = 0;
    open(&scene, IO_CAN_STREAM, NODE, &full_speed);
    send_motion(&scene, 1);
    CHECK_EQUAL(one_round(&scene, ROOM, 12), 0);
    CHECK(!may_stay_unread(&scene)); // the node is being reached
    pump(&scene, ROOM);
    CHECK(!may_stay_unread(&scene)); // nothing waits
    io_free(scene.bus);

    open(&scene, IO_CAN_STREAM, NODE, &full_speed);
    run_up(&scene);
    scene.now_ns += 1000 * MS; // the budget holds nothing back
    CHECK(!may_stay_unread(&scene));
    send_motion(&scene, 1);
    pump(&scene, ROOM);
    send_motion(&scene, 1);
    CHECK_EQUAL(one_round(&scene, ROOM, 12), 0);
    CHECK(may_stay_unread(&scene));
    CHECK(io_may_stay_unread(scene.bus, scene.now_ns + 9 * 120000 - 1));
    CHECK(!io_may_stay_unread(scene.bus, scene.now_ns + 9 * 120000)); // it is to be sent now
    CHECK_EQUAL(io_hurry(scene.bus, scene.link, 1), IO_OK);
    CHECK(!may_stay_unread(&scene));
    CHECK_EQUAL(io_hurry(scene.bus, scene.link, 0), IO_OK);
    CHECK(may_stay_unread(&scene));
    CHECK_EQUAL(io_send_frame(scene.bus, TO_PYTHON_ID, &data, 1), IO_OK);
    CHECK(!may_stay_unread(&scene)); // to which a node may answer
    CHECK_EQUAL(one_round(&scene, ROOM, 11), FRAME);
    CHECK_EQUAL(one_round(&scene, ROOM, 12), 0);
    CHECK(may_stay_unread(&scene));

    scene.now_ns += 5 * MS; // all that waited in the kernel is on its way
    CHECK_EQUAL(pump(&scene, ROOM), FULL_BLOCK_FRAMES);
    answer(&scene, NULL, 0);
    scene.now_ns += 5 * MS;
    send_of(&scene, LINK_CONTROL, 30);
    CHECK_EQUAL(pump(&scene, ROOM), 5);
    send_motion(&scene, 1);
    CHECK_EQUAL(one_round(&scene, ROOM, 12), 0);
    CHECK(!may_stay_unread(&scene)); // an answer is awaited
    answer(&scene, NULL, 0);
    CHECK_EQUAL(one_round(&scene, ROOM, 12), 0);
    CHECK(may_stay_unread(&scene));
    io_end(scene.bus, 0);
    CHECK(!may_stay_unread(&scene));
    io_free(scene.bus);
}

// A command that shares a block with motion is answered, too.
static void an_answer_to_what_motion_took_along_is_awaited(void) {
    struct scene scene;
    uint8_t batch[BATCH_HEADER + 10];
    size_t size = batch_write(batch, 0, 0, (const uint8_t *)"ten bytes.", 10);
    open(&scene, IO_CAN_STREAM, NODE, &full_speed);
    run_up(&scene);
    scene.now_ns += 1000 * MS;
    CHECK_EQUAL(io_send_batch(scene.bus, scene.link, batch, size), IO_OK);
    send_of(&scene, LINK_CONTROL, 1);
    unsigned blocks = scene.blocks;
    pump(&scene, ROOM);
    CHECK_EQUAL(scene.blocks - blocks, 1);
    send_motion(&scene, 1);
    CHECK_EQUAL(one_round(&scene, ROOM, 12), 0);
    CHECK(!may_stay_unread(&scene));
    io_free(scene.bus);
}

static void a_slow_bus_is_read_meanwhile(void) {
    struct scene scene;
    static const struct io_settings settings = {.bitrate = 500000, .queue_frames = 12};
    open(&scene, IO_CAN_STREAM, NODE, &settings);
    run_up(&scene);
    scene.now_ns += 1000 * MS;
    send_motion(&scene, 1);
    CHECK_EQUAL(one_round(&scene, ROOM, 12), 0);
    check_deadline(&scene, 9 * 240000);
    CHECK(!may_stay_unread(&scene));
    io_free(scene.bus);
}

// -------------------------------------------------------------------------------------------------- counting

// A frame that is full with one block's end counts for that block's class.
static void frames_count_for_the_class_of_their_block(void) {
    struct scene scene;
    open(&scene, IO_CAN_STREAM, NODE, &full_speed);
    run_up(&scene);
    scene.now_ns += 1000 * MS;
    const struct io_link_stats before = link_stats(&scene);
    send_of(&scene, LINK_CONTROL, WIRE_CONTENT_MAX);
    send_of(&scene, LINK_BULK, WIRE_CONTENT_MAX);
    CHECK_EQUAL(one_round(&scene, ROOM, 0), 12 * FRAME); // the queue is full
    scene.now_ns += 2 * MS;
    CHECK_EQUAL(one_round(&scene, ROOM, 0), 4 * FRAME);
    bus_stats(&scene);
    const struct io_link_stats after = link_stats(&scene);
    for (int kind = LINK_CONTROL; kind <= LINK_BULK; kind++) {
        CHECK_EQUAL(after.flows[kind].frames - before.flows[kind].frames, FULL_BLOCK_FRAMES);
        CHECK_EQUAL(after.flows[kind].blocks - before.flows[kind].blocks, 1);
    }
    io_free(scene.bus);
}

// Two short blocks that were lost are repeated in as few frames as their bytes need: 52 bytes to wake the
// node up and 12 of theirs.
static void repeats_share_frames(void) {
    struct scene scene;
    open(&scene, IO_CAN_STREAM, NODE, &full_speed);
    run_up(&scene);
    for (int i = 0; i < 2; i++) {
        send_of(&scene, LINK_CONTROL, 1);
        uint8_t lost[ROOM];
        CHECK_EQUAL(io_next(scene.bus, scene.now_ns, 0, lost, ROOM), FRAME);
        CHECK_EQUAL(io_next(scene.bus, scene.now_ns, 0, lost, ROOM), 0);
        CHECK_EQUAL(lost[4], 6);
    }
    unsigned blocks = scene.blocks;
    scene.now_ns = io_deadline(scene.bus, scene.now_ns);
    io_handle_time(scene.bus, scene.now_ns);
    CHECK_EQUAL(pump(&scene, ROOM), 8);
    CHECK_EQUAL(scene.blocks, blocks + 2);
    io_free(scene.bus);
}

// The forecast learns what motion costs from what motion has cost, and from nothing else.
static void the_cost_of_motion_is_learned_from_motion(void) {
    struct scene scene;
    open(&scene, IO_BYTES, 0, &full_speed);
    run_up(&scene);
    uint8_t batch[BATCH_HEADER + 27];
    size_t size = batch_write(batch, 0, 0, (const uint8_t *)"an odd length, 27 bytes long", 27);
    uint64_t content = 0;
    CHECK_EQUAL(io_set_clock(scene.bus, scene.link, 1e6, 0, 0), IO_OK);
    while (content < LEARNED_BYTES) {
        send_of(&scene, LINK_CONTROL, 40); // goes by itself: both do not fit into a block
        pump(&scene, ROOM);
        answer(&scene, NULL, 0);
        CHECK_EQUAL(io_send_batch(scene.bus, scene.link, batch, size), IO_OK);
        content += 27;
        pump(&scene, ROOM);
        scene.now_ns += 10 * MS;
        answer(&scene, NULL, 0);
    }
    CHECK_EQUAL(sent_bits(&scene, LINK_MOTION), content / 27 * 32 * 10);
    batch_write(batch, 0, 4000000, batch + BATCH_HEADER, 27); // due in some time: it waits
    struct io_forecast forecast;
    CHECK_EQUAL(io_send_batch(scene.bus, scene.link, batch, size), IO_OK);
    io_forecast(scene.bus, &forecast);
    CHECK_EQUAL(forecast.queued_bits, 320);
    io_free(scene.bus);
}

int main(void) {
    a_serial_lines_bytes_are_counted_as_they_go();
    a_serial_lines_blocks_go_as_far_as_there_is_room();
    a_serial_lines_queue_fills_block_by_block();
    the_budget_holds_bulk_back_until_it_is_paid();
    a_full_queue_and_a_spent_budget_wait_for_the_sooner();
    a_full_queue_is_waited_for_only_with_something_to_send();
    a_stop_waits_neither_for_the_queue_nor_for_other_frames();
    acknowledgements_of_motion_wait_until_more_can_be_sent();
    an_answer_to_what_motion_took_along_is_awaited();
    a_slow_bus_is_read_meanwhile();
    frames_count_for_the_class_of_their_block();
    repeats_share_frames();
    the_cost_of_motion_is_learned_from_motion();
    return 0;
}
