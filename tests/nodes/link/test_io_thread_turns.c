// SPDX-License-Identifier: Apache-2.0
// sources: firmware/wire/*.c nodes/link/core/*.c nodes/link/io/io_[a-su-z]*.c nodes/support/can_bits.c
// What the thread of a bus asks of the kernel, call by call, whatever the kernel answers.
#define _GNU_SOURCE
#include "tests/nodes/link/scripted_kernel.h"

#include "nodes/link/core/batch.h"
#include "nodes/link/io/io_thread.c" // its calls of the kernel go to the script

#define MS 1000000ULL

enum { NODE = 4, ADMIN_ID = 0x3F0, STREAM_ROOM = 64 * FRAME, FULL_SPEED = 1000000 };

static const struct io_settings unknown_speed = {0}, full_speed = {.bitrate = FULL_SPEED};
static const struct link_settings usual = {.receive_window = 192, .lost_after_ns = 60000 * MS};
static const struct can_frame a_frame = {.can_id = ADMIN_ID + 1, .can_dlc = 3, .data = {1, 2, 3}};

static struct io_thread *start(enum io_kind kind, const struct io_settings *settings) {
    kernel_reset();
    struct io_thread *thread = io_start(LINE_FD, kind, settings);
    CHECK(thread);
    CHECK(thread->bus == io_thread_bus(thread));
    return thread;
}

static void stop(struct io_thread *thread) {
    io_stop(thread);
    CHECK_EQUAL(kernel_open_fds(), 0);
    CHECK_EQUAL(kernel.threads, 0);
    CHECK(!kernel.mutex_exists);
}

static void reading_gives(ssize_t size, int error, const void *data) {
    kernel.reads[kernel.reads_at + kernel.reads_left++] =
        (struct step){.size = size, .error = error, .data = data};
}

static void writing_gives(ssize_t size, int error) {
    kernel.writes[kernel.writes_at + kernel.writes_left++] = (struct step){.size = size, .error = error};
}

static enum io_status send_frame(struct io_thread *thread, uint8_t value) {
    const uint8_t data[] = {value, 0x55, 0x55, 0x55, 0x55, 0x55, 0x55, 0x55}; // no stuff bits
    return io_send_frame(thread->bus, ADMIN_ID, data, sizeof data);
}

// The frames with the VALUES and nothing else went to the line, since this was asked last.
static void check_sent(const uint8_t *values, size_t size) {
    CHECK_EQUAL(kernel.sent_size, size * FRAME);
    for (size_t i = 0; i < size; i++) {
        struct can_frame frame;
        memcpy(&frame, kernel.sent + i * FRAME, FRAME);
        CHECK(frame.can_id == ADMIN_ID && frame.can_dlc == 8 && frame.data[0] == values[i]);
    }
    kernel.sent_size = 0;
}

static struct io_stats stats_of(struct io_thread *thread) {
    struct io_stats stats;
    io_get_stats(thread->bus, &stats);
    return stats;
}

static void check_sleep(short events, int64_t timeout_ns) {
    CHECK_EQUAL(kernel.line_fd, LINE_FD);
    CHECK_EQUAL(kernel.line_events, events);
    CHECK_EQUAL(kernel_timeout_ns(), timeout_ns);
    CHECK(!kernel_is_woken());
}

// The end is told once, and the thread does not look at the line any more.
static void check_ended(struct io_thread *thread, int cause) {
    struct io_event event;
    CHECK_EQUAL(io_take(thread->bus, &event, 1), 1);
    CHECK_EQUAL(event.notice, IO_ENDED);
    CHECK_EQUAL(event.value, cause);
    if (kernel_is_woken())
        kernel_turn(0);
    CHECK_EQUAL(kernel.line_fd, -1);
    CHECK_EQUAL(kernel_timeout_ns(), -1);
    CHECK_EQUAL(send_frame(thread, 9), IO_CLOSED);
    CHECK_EQUAL(kernel.write_calls, 0);
}

// --------------------------------------------------------------------------------------------- start and end

static void a_thread_starts_with_a_look_at_the_line_and_sleeps(enum io_kind kind) {
    struct io_thread *thread = start(kind, &unknown_speed);
    CHECK_EQUAL(kernel.threads, 1);
    CHECK_EQUAL(kernel_open_fds(), 3);
    CHECK_EQUAL(io_notice_fd(thread), 4);
    CHECK_EQUAL(kernel.send_buffer, kind == IO_BYTES ? -1 : 16 * KERNEL_BUFFER / 2); // 16 frames
    CHECK_EQUAL(kernel.read_calls, 1);
    CHECK_EQUAL(kernel.read_room, kind == IO_CAN_PACKET ? FRAME : STREAM_ROOM);
    check_sleep(POLLIN, -1);
    CHECK_EQUAL(stats_of(thread).wakeups, 0);
    kernel_turn(POLLERR); // that is seen by reading
    CHECK_EQUAL(kernel.read_calls, 1);
    kernel_turn(POLLIN);
    kernel_turn(POLLIN);
    CHECK_EQUAL(stats_of(thread).wakeups, 3);
    stop(thread);
}

// Descriptor 0 is as good as any: a program may have closed its standard input.
static void a_start_that_fails_leaves_nothing_behind(void) {
    static const struct {
        int wake_fd, notice_fd, timer_fd, thread_error, starts;
    } cases[] = {{0, 4, 5, 0, 1},  {3, 0, 5, 0, 1},  {3, 4, 0, 0, 1},    {-1, 4, 5, 0, 0},
                 {3, -1, 5, 0, 0}, {3, 4, -1, 0, 0}, {-1, -1, -1, 0, 0}, {3, 4, 5, EAGAIN, 0}};
    for (size_t i = 0; i < sizeof cases / sizeof *cases; i++) {
        kernel_reset();
        kernel.next_event_fd[0] = cases[i].wake_fd;
        kernel.next_event_fd[1] = cases[i].notice_fd;
        kernel.next_timer_fd = cases[i].timer_fd;
        kernel.thread_error = cases[i].thread_error;
        struct io_thread *thread = io_start(LINE_FD, IO_BYTES, &unknown_speed);
        CHECK_EQUAL(thread != NULL, cases[i].starts);
        CHECK_EQUAL(kernel.threads, cases[i].starts);
        if (thread)
            stop(thread);
        CHECK_EQUAL(kernel_open_fds(), 0);
        CHECK(!kernel.mutex_exists);
    }
    kernel_reset();
    kernel.no_memory = 1;
    CHECK(!io_start(LINE_FD, IO_BYTES, &unknown_speed));
    CHECK_EQUAL(kernel.event_calls, 0);
}

// --------------------------------------------------------------------------------------------------- reading

static void check_frames(struct io_thread *thread, size_t wanted) {
    struct io_event events[80];
    CHECK_EQUAL(kernel.count[4], wanted > 0);
    CHECK_EQUAL(io_take(thread->bus, events, 80), wanted);
    CHECK_EQUAL(kernel.count[4], 0); // nothing is left to take
    for (size_t i = 0; i < wanted; i++) {
        CHECK_EQUAL(events[i].notice, IO_FRAME);
        CHECK_EQUAL(events[i].can_id, a_frame.can_id);
        CHECK_EQUAL(events[i].received_ns, kernel.now_ns);
        CHECK(events[i].size == 3 && memcmp(events[i].content, a_frame.data, 3) == 0);
    }
}

// A stream that gave less than it could is empty; packets come one by one until there is none.
static void the_line_is_read_until_it_is_empty(void) {
    static struct can_frame frames[STREAM_ROOM / FRAME];
    for (size_t i = 0; i < STREAM_ROOM / FRAME; i++)
        frames[i] = a_frame;
    struct io_thread *thread = start(IO_CAN_STREAM, &unknown_speed);
    kernel.now_ns += 77;
    reading_gives(FRAME, 0, frames);
    kernel_turn(POLLIN);
    CHECK_EQUAL(kernel.read_calls, 1);
    check_frames(thread, 1);
    reading_gives(STREAM_ROOM, 0, frames);
    reading_gives(STREAM_ROOM - 1, 0, frames);
    kernel_turn(POLLIN);
    CHECK_EQUAL(kernel.read_calls, 2);
    reading_gives(1, 0, (const uint8_t *)&a_frame + FRAME - 1);
    struct io_event event;
    while (io_take(thread->bus, &event, 1)) // 127 of them
        ;
    kernel_turn(POLLIN);
    check_frames(thread, 1);
    CHECK_EQUAL(stats_of(thread).frames_received, 129);
    stop(thread);

    thread = start(IO_CAN_PACKET, &unknown_speed);
    reading_gives(FRAME, 0, frames);
    reading_gives(FRAME - 1, 0, frames); // that is none, but the next may be
    reading_gives(-1, EINTR, NULL);
    reading_gives(FRAME, 0, frames);
    kernel_turn(POLLIN);
    CHECK_EQUAL(kernel.read_calls, 5);
    check_frames(thread, 2);
    CHECK_EQUAL(stats_of(thread).frames_malformed, 1);
    stop(thread);

    thread = start(IO_BYTES, &unknown_speed);
    reading_gives(1, ENODEV, (const uint8_t *)"x"); // errno counts only after a failure
    kernel_turn(POLLIN);
    CHECK_EQUAL(kernel.read_calls, 1);
    CHECK_EQUAL(stats_of(thread).bytes_received, 1);
    CHECK(!io_ended(thread->bus));
    stop(thread);
}

// The notice is given after the lock is free, so it may come when the events were taken already.
static void a_late_notice_of_nothing_ends(void) {
    struct io_thread *thread = start(IO_CAN_STREAM, &unknown_speed);
    reading_gives(FRAME, 0, &a_frame);
    kernel_turn(POLLIN);
    check_frames(thread, 1);
    kernel.count[4] = 1;
    struct io_event event;
    CHECK_EQUAL(io_take(thread->bus, &event, 1), 0);
    CHECK_EQUAL(kernel.count[4], 0);
    stop(thread);
}

static void a_flood_does_not_keep_the_thread_from_sending(void) {
    struct io_thread *thread = start(IO_CAN_PACKET, &unknown_speed);
    writing_gives(-1, EAGAIN);
    CHECK_EQUAL(send_frame(thread, 1), IO_OK);
    kernel_turn(0);
    kernel.flood = &a_frame;
    kernel_turn(POLLIN | POLLOUT);
    CHECK_EQUAL(kernel.read_calls, 1024);
    CHECK_EQUAL(kernel.write_calls, 1);
    kernel_turn(POLLIN);
    CHECK_EQUAL(kernel.read_calls, 1024);
    stop(thread);
}

static void a_line_may_end_while_it_is_read(void) {
    static const struct {
        ssize_t size;
        int error, cause;
    } ends[] = {{0, EAGAIN, 0}, {-1, ENETDOWN, ENETDOWN}, {-1, EIO, EIO}};
    for (size_t i = 0; i < sizeof ends / sizeof *ends; i++) {
        struct io_thread *thread = start(IO_CAN_PACKET, &unknown_speed);
        reading_gives(FRAME, 0, (const uint8_t *)&a_frame);
        reading_gives(ends[i].size, ends[i].error, NULL);
        reading_gives(FRAME, 0, (const uint8_t *)&a_frame);
        kernel_turn(POLLIN);
        CHECK_EQUAL(kernel.read_calls, 2);
        struct io_event events[3];
        CHECK_EQUAL(io_take(thread->bus, events, 3), 2);
        CHECK(events[0].notice == IO_FRAME && events[1].notice == IO_ENDED);
        stop(thread);
        thread = start(IO_CAN_PACKET, &unknown_speed);
        reading_gives(ends[i].size, ends[i].error, NULL);
        kernel_turn(POLLIN);
        check_ended(thread, ends[i].cause);
        stop(thread);
    }
}

// --------------------------------------------------------------------------------------------------- writing

// Who sends does so by itself: the thread sleeps on.
static void what_is_sent_goes_at_once(enum io_kind kind) {
    struct io_thread *thread = start(kind, &unknown_speed);
    CHECK_EQUAL(send_frame(thread, 1), IO_OK);
    CHECK_EQUAL(kernel.write_calls, 1);
    CHECK_EQUAL(kernel.write_sizes[0], FRAME);
    CHECK_EQUAL(kernel.queue_calls, 0); // the queue of an unknown line is not bounded
    check_sent((const uint8_t[]){1}, 1);
    check_sleep(POLLIN, -1);
    kernel.write_calls = 0;
    writing_gives(-1, EINTR);
    writing_gives(1, EINTR);
    writing_gives(5, ENODEV);
    CHECK_EQUAL(send_frame(thread, 2), IO_OK);
    CHECK_EQUAL(kernel.write_calls, 4);
    if (kind == IO_CAN_STREAM) {
        CHECK(kernel.write_sizes[1] == FRAME && kernel.write_sizes[2] == FRAME - 1);
        CHECK_EQUAL(kernel.write_sizes[3], FRAME - 6);
        check_sent((const uint8_t[]){2}, 1);
    }
    check_sleep(POLLIN, -1);
    CHECK_EQUAL(stats_of(thread).waits, 0);
    stop(thread);
}

// ERROR: what errno says; SIZE 0: what it said before, since nothing failed.
static void a_full_kernel_is_waited_for(enum io_kind kind, ssize_t size, int error) {
    struct io_thread *thread = start(kind, &unknown_speed);
    writing_gives(size, error);
    CHECK_EQUAL(send_frame(thread, 1), IO_OK);
    CHECK_EQUAL(kernel.write_calls, 1);
    CHECK(kernel_is_woken()); // to wait for the line
    for (uint8_t i = 2; i < 5; i++)
        CHECK_EQUAL(send_frame(thread, i), IO_OK);
    CHECK_EQUAL(kernel.count[3], 1); // once is enough
    CHECK_EQUAL(kernel.write_calls, 1);
    kernel_turn(0);
    CHECK(kernel.write_calls == 0 && kernel.read_calls == 0);
    check_sleep(POLLIN | POLLOUT, -1);
    CHECK_EQUAL(stats_of(thread).waits, 1);
    CHECK_EQUAL(send_frame(thread, 5), IO_OK);
    CHECK_EQUAL(kernel.write_calls, 0);
    CHECK(!kernel_is_woken()); // it waits for the line already
    kernel_turn(POLLIN);
    CHECK(kernel.write_calls == 0 && kernel.read_calls == 1);
    kernel_turn(POLLOUT);
    CHECK_EQUAL(kernel.read_calls, 0);
    CHECK_EQUAL(kernel.write_calls, kind == IO_CAN_STREAM ? 2 : 5);
    CHECK_EQUAL(kernel.write_sizes[0], FRAME);
    CHECK_EQUAL(kernel.write_sizes[1], kind == IO_CAN_STREAM ? 4 * FRAME : FRAME);
    check_sent((const uint8_t[]){1, 2, 3, 4, 5}, 5);
    check_sleep(POLLIN, -1);
    CHECK_EQUAL(stats_of(thread).waits, 1);
    stop(thread);
}

// SocketCAN calls the socket writable all the same: only time helps.
static void a_kernel_without_buffers_is_asked_again_later(void) {
    struct io_thread *thread = start(IO_CAN_PACKET, &unknown_speed);
    writing_gives(-1, ENOBUFS);
    CHECK_EQUAL(send_frame(thread, 1), IO_OK);
    check_sleep(POLLIN, 300000); // it wakes by itself in time
    CHECK_EQUAL(send_frame(thread, 2), IO_OK);
    kernel.now_ns += 299999;
    CHECK_EQUAL(send_frame(thread, 3), IO_OK);
    CHECK_EQUAL(kernel.write_calls, 1);
    check_sleep(POLLIN, 1);
    kernel_turn(POLLIN);
    CHECK(kernel.write_calls == 0 && kernel.read_calls == 1);
    check_sleep(POLLIN, 1);
    kernel_sleep_out(0);
    CHECK_EQUAL(kernel.read_calls, 0);
    CHECK_EQUAL(kernel.write_calls, 3);
    check_sent((const uint8_t[]){1, 2, 3}, 3);
    check_sleep(POLLIN, -1);
    CHECK_EQUAL(stats_of(thread).waits, 1);

    writing_gives(-1, ENOBUFS);
    CHECK_EQUAL(send_frame(thread, 4), IO_OK);
    check_sleep(POLLIN, 300000);
    reading_gives(0, 0, NULL);
    kernel_turn(POLLIN);
    check_ended(thread, 0); // nothing is tried again
    stop(thread);
}

static void a_line_may_end_while_it_is_written(void) {
    struct io_thread *thread = start(IO_CAN_STREAM, &unknown_speed);
    writing_gives(-1, ENODEV);
    CHECK_EQUAL(send_frame(thread, 1), IO_OK);
    CHECK_EQUAL(kernel.write_calls, 1);
    CHECK(kernel_is_woken()); // lest it go on polling
    kernel_turn(0);
    CHECK_EQUAL(kernel.write_calls, 0);
    check_ended(thread, ENODEV);
    stop(thread);
}

// ----------------------------------------------------------------------------------------- reading meanwhile

// The node acknowledges everything before SEQUENCE.
static void node_acknowledges(unsigned sequence) {
    static struct can_frame frame;
    frame = (struct can_frame){.can_id = 0x100 + 2 * NODE + 1, .can_dlc = WIRE_BLOCK_MIN};
    wire_block_finish(frame.data, 0, sequence % 16);
    reading_gives(FRAME, 0, (const uint8_t *)&frame);
}

static uint32_t running_link(struct io_thread *thread) {
    uint32_t link;
    CHECK_EQUAL(io_open_link(thread->bus, NODE, &usual, &link), IO_OK);
    CHECK_EQUAL(io_send(thread->bus, link, LINK_CONTROL, (const uint8_t *)"\5", 1, 0, 0), IO_OK);
    for (unsigned sequence = 1; sequence <= 3; sequence++) {
        kernel.now_ns += MS;
        node_acknowledges(sequence);
        kernel_turn(POLLIN);
    }
    kernel.now_ns += 1000 * MS;
    return link;
}

// Three full blocks, 24 frames, of which 12 go at once and 9 when 3 of these are left.
static void send_motion(struct io_thread *thread, uint32_t link) {
    uint8_t batch[BATCH_HEADER + WIRE_CONTENT_MAX];
    size_t size = batch_write(batch, 0, 0, (const uint8_t[WIRE_CONTENT_MAX]){4}, WIRE_CONTENT_MAX);
    for (int i = 0; i < 3; i++)
        CHECK_EQUAL(io_send_batch(thread->bus, link, batch, size), IO_OK);
    kernel_sleep_out(0);
    CHECK_EQUAL(kernel.line_fd, -1);
    CHECK_EQUAL(kernel_timeout_ns(), 9 * 120000);
    CHECK(!kernel_is_woken());
}

// Acknowledgements of motion do not wake the thread while it has to wake for the rest anyway; it reads then.
static void acknowledgements_wait_for_the_rest_of_the_motion(void) {
    struct io_thread *thread = start(IO_CAN_STREAM, &full_speed);
    uint32_t link = running_link(thread);
    send_motion(thread, link);
    node_acknowledges(4);
    kernel_sleep_out(0);
    CHECK_EQUAL(kernel.read_calls, 1);
    CHECK_EQUAL(kernel.write_calls, 1);
    CHECK_EQUAL(kernel.line_fd, LINE_FD); // everything is sent
    struct io_link_stats stats;
    CHECK_EQUAL(io_get_link_stats(thread->bus, link, &stats), IO_OK);
    CHECK_EQUAL(stats.in_flight_blocks, 2);
    kernel_turn(0);
    CHECK_EQUAL(kernel.read_calls, 0);
    stop(thread);
}

static void who_wants_an_answer_has_the_line_read_at_once(void) {
    struct io_thread *thread = start(IO_CAN_STREAM, &full_speed);
    uint32_t link = running_link(thread);
    send_motion(thread, link);
    CHECK_EQUAL(io_hurry(thread->bus, link, 1), IO_OK);
    CHECK(kernel_is_woken());
    kernel_turn(0);
    CHECK_EQUAL(kernel.read_calls, 1);
    CHECK_EQUAL(kernel.line_fd, LINE_FD);
    stop(thread);
}

// ------------------------------------------------------------------------------------------------------ time

// The node never answers. Its first block is repeated after 100 ms, then after twice as long each time.
static void the_thread_sleeps_until_the_next_deadline(void) {
    struct io_thread *thread = start(IO_BYTES, &unknown_speed);
    uint32_t link;
    uint64_t blocks = 1;
    struct io_link_stats stats;
    CHECK_EQUAL(io_open_link(thread->bus, 0, &usual, &link), IO_OK);
    CHECK_EQUAL(io_send(thread->bus, link, LINK_CONTROL, (const uint8_t *)"\5", 1, 0, 0), IO_OK);
    CHECK_EQUAL(kernel.write_calls, 1);
    for (uint64_t wait_ms = 100; wait_ms <= 3200; wait_ms *= 2) {
        check_sleep(POLLIN, (int64_t)(wait_ms * MS));
        kernel.now_ns += MS;
        CHECK_EQUAL(io_send(thread->bus, link, LINK_CONTROL, (const uint8_t *)"\5", 1, 0, 0), IO_OK);
        kernel.now_ns -= MS;
        check_sleep(POLLIN, (int64_t)(wait_ms * MS)); // the deadline is as before
        kernel_sleep_out(0);
        CHECK_EQUAL(kernel.read_calls, 0);
        CHECK_EQUAL(kernel.write_calls, 1);
        CHECK_EQUAL(io_get_link_stats(thread->bus, link, &stats), IO_OK);
        CHECK_EQUAL(stats.link.blocks_sent, ++blocks);
    }
    stop(thread);
}

// A deadline that passes is seen once: the timer is set again or disarmed, and not set without need.
static void the_timer_is_set_when_the_deadline_changes(void) {
    struct io_thread *thread = start(IO_CAN_STREAM, &unknown_speed);
    CHECK_EQUAL(kernel.timer_calls, 1); // disarmed
    CHECK_EQUAL(send_frame(thread, 1), IO_OK);
    kernel_turn(POLLIN);
    CHECK_EQUAL(kernel.timer_calls, 1);
    writing_gives(-1, ENOBUFS);
    CHECK_EQUAL(send_frame(thread, 2), IO_OK);
    CHECK_EQUAL(kernel.timer_calls, 2);
    kernel_turn(POLLIN);
    CHECK_EQUAL(kernel.timer_calls, 2);
    kernel_sleep_out(0);
    check_sleep(POLLIN, -1);
    CHECK_EQUAL(kernel.timer_calls, 3);
    CHECK_EQUAL(stats_of(thread).wakeups, 3);
    stop(thread);
}

// Who woke much too late reads before it judges by the time: the answer may be there.
static void a_thread_that_overslept_reads_first(void) {
    struct io_thread *thread = start(IO_BYTES, &unknown_speed);
    uint32_t link;
    CHECK_EQUAL(io_open_link(thread->bus, 0, &usual, &link), IO_OK);
    CHECK_EQUAL(io_send(thread->bus, link, LINK_CONTROL, (const uint8_t *)"\5", 1, 0, 0), IO_OK);
    kernel_sleep_out(2 * MS);
    CHECK_EQUAL(kernel.read_calls, 0);
    kernel_sleep_out(2 * MS + 1);
    CHECK_EQUAL(kernel.read_calls, 1);
    stop(thread);
}

// A computer that is busy stops the thread before a read: what this gives may have come meanwhile, so its
// time is no earlier than its read. Who judges by the time afterwards judges by the last.
static void what_is_read_has_the_time_of_its_read(void) {
    struct io_thread *thread = start(IO_CAN_PACKET, &unknown_speed);
    struct io_event events[3];
    uint64_t began_ns = kernel.now_ns;
    for (size_t i = 0; i < 3; i++) {
        reading_gives(FRAME, 0, &a_frame);
        kernel.reads[i].takes_ns = 7 * MS;
    }
    kernel_turn(POLLIN);
    CHECK_EQUAL(io_take(thread->bus, events, 3), 3);
    for (size_t i = 0; i < 3; i++)
        CHECK_EQUAL(events[i].received_ns, began_ns + (i + 1) * 7 * MS);
    stop(thread);
}

// -------------------------------------------------------------------------------------------- kernel's queue

// How many of 19 frames follow one that was refused, when the kernel has WAITING bytes of memory in use and
// the line takes frames again. The rest follows, 12 at a time.
static size_t frames_that_go(struct io_thread *thread, uint32_t waiting) {
    kernel.growth = KERNEL_BUFFER;
    kernel.waiting = 0;
    kernel.now_ns += 1000 * MS; // the core's own estimate is that nothing waits
    writing_gives(-1, EAGAIN);
    for (uint8_t i = 0; i < 20; i++)
        CHECK_EQUAL(send_frame(thread, i), IO_OK);
    kernel_turn(0);
    kernel.now_ns += 1000 * MS;
    kernel.waiting = waiting;
    kernel_turn(POLLOUT);
    CHECK_EQUAL(kernel.write_sizes[0], FRAME);
    CHECK_EQUAL(kernel.queue_calls, kernel.write_calls);
    size_t gone = kernel.write_calls > 1 ? kernel.write_sizes[1] / FRAME : 0, left = 20;
    for (size_t i = 0; i < kernel.write_calls; i++)
        left -= kernel.write_sizes[i] / FRAME;
    while (left > 0) {
        kernel.waiting = 0;
        kernel.now_ns += 1000 * MS;
        kernel_turn(POLLIN);
        CHECK_EQUAL(kernel.write_calls, 1);
        CHECK_EQUAL(kernel.write_sizes[0], (left < 12 ? left : 12) * FRAME);
        left -= kernel.write_sizes[0] / FRAME;
    }
    kernel.sent_size = kernel.writes_at = 0;
    return gone;
}

// Frames in PIECES, all of which are less than a frame: such count for none.
static void write_crumbs(struct io_thread *thread, unsigned pieces) {
    for (unsigned frames = (pieces + 7) / 8; frames > 0; frames--) {
        unsigned crumbs = pieces < 8 ? pieces : 8;
        for (unsigned i = 1; i < crumbs; i++)
            writing_gives(2, 0);
        writing_gives((ssize_t)(FRAME - 2 * (crumbs - 1)), 0);
        pieces -= crumbs;
        kernel.waiting = 0;
        kernel.now_ns += 1000 * MS;
        CHECK_EQUAL(send_frame(thread, 0), IO_OK);
        CHECK_EQUAL(kernel.writes_left, 0);
    }
    kernel.sent_size = kernel.writes_at = 0;
}

// 12 frames may wait at this speed. A buffer of the kernel holds one write, of however many frames; the
// refused frame is a write of its own.
static void a_sockets_buffers_are_counted_as_the_writes_they_hold(void) {
    struct io_thread *thread = start(IO_CAN_STREAM, &full_speed);
    static const struct {
        uint32_t waiting;
        int error;
        size_t goes;
    } steps[] = {
        {5 * KERNEL_BUFFER, 0, 11},    // nothing was written before; frames of all writes now: 1, 11, 8
        {0, 0, 11},                    // and 1, 11, 8
        {KERNEL_BUFFER - 1, 0, 11},    // and 1, 11, 8
        {KERNEL_BUFFER, 0, 3},         // 12 less 1 and 8; and 1, 3, 12, 4
        {2 * KERNEL_BUFFER - 1, 0, 7}, // 12 less 1 and 4; and 1, 7, 12
        {2 * KERNEL_BUFFER, 0, 0},     // 12 and 7 wait; and 1, 12, 7
        {KERNEL_BUFFER, 0, 4},         // 12 less 1 and 7; and 1, 4, 12, 3
        {9 * KERNEL_BUFFER, EINVAL, 12}
        // the kernel does not tell: by the bit rate all have gone; and 1, 12, 7
    };
    for (size_t i = 0; i < sizeof steps / sizeof *steps; i++) {
        kernel.queue_error = steps[i].error;
        CHECK_EQUAL(frames_that_go(thread, steps[i].waiting), steps[i].goes);
    }
    kernel.queue_error = 0;
    write_crumbs(thread, 31); // with the refused frame 32 writes: of more nothing is known
    CHECK_EQUAL(frames_that_go(thread, 40 * KERNEL_BUFFER), 11); // and 1, 11, 8
    write_crumbs(thread, 30);
    CHECK_EQUAL(frames_that_go(thread, 40 * KERNEL_BUFFER), 3); // 12 less 1 and 8
    stop(thread);
}

static void a_serial_lines_bytes_are_counted(void) {
    static const struct io_settings bounded = {.bitrate = 250000, .queue_frames = 20};
    struct io_thread *thread = start(IO_BYTES, &bounded);
    uint32_t link;
    CHECK_EQUAL(io_open_link(thread->bus, 0, &usual, &link), IO_OK);
    kernel.waiting = 20;
    kernel.queue_calls = 0;
    CHECK_EQUAL(io_send(thread->bus, link, LINK_CONTROL, (const uint8_t *)"\5", 1, 0, 0), IO_OK);
    CHECK_EQUAL(kernel.queue_calls, 1);
    CHECK_EQUAL(kernel.write_calls, 0);
    kernel.waiting = 19;
    kernel_turn(0);
    CHECK_EQUAL(kernel.write_calls, 1);
    CHECK_EQUAL(kernel.queue_calls, 2);
    stop(thread);

    thread = start(IO_BYTES, &bounded);
    kernel.waiting = 20;
    kernel.queue_error = ENOTTY; // it does not tell: nothing was sent, so nothing waits
    CHECK_EQUAL(io_open_link(thread->bus, 0, &usual, &link), IO_OK);
    CHECK_EQUAL(io_send(thread->bus, link, LINK_CONTROL, (const uint8_t *)"\5", 1, 0, 0), IO_OK);
    CHECK_EQUAL(kernel.write_calls, 1);
    stop(thread);
}

int main(void) {
    a_thread_starts_with_a_look_at_the_line_and_sleeps(IO_BYTES);
    a_thread_starts_with_a_look_at_the_line_and_sleeps(IO_CAN_STREAM);
    a_thread_starts_with_a_look_at_the_line_and_sleeps(IO_CAN_PACKET);
    a_start_that_fails_leaves_nothing_behind();
    the_line_is_read_until_it_is_empty();
    a_late_notice_of_nothing_ends();
    a_flood_does_not_keep_the_thread_from_sending();
    a_line_may_end_while_it_is_read();
    what_is_sent_goes_at_once(IO_CAN_STREAM);
    what_is_sent_goes_at_once(IO_CAN_PACKET);
    a_full_kernel_is_waited_for(IO_CAN_STREAM, -1, EAGAIN);
    a_full_kernel_is_waited_for(IO_CAN_PACKET, -1, EAGAIN);
    a_full_kernel_is_waited_for(IO_CAN_STREAM, 0, EINTR);
    a_full_kernel_is_waited_for(IO_CAN_STREAM, 0, ENOBUFS);
    a_kernel_without_buffers_is_asked_again_later();
    a_line_may_end_while_it_is_written();
    acknowledgements_wait_for_the_rest_of_the_motion();
    who_wants_an_answer_has_the_line_read_at_once();
    the_thread_sleeps_until_the_next_deadline();
    the_timer_is_set_when_the_deadline_changes();
    a_thread_that_overslept_reads_first();
    what_is_read_has_the_time_of_its_read();
    a_sockets_buffers_are_counted_as_the_writes_they_hold();
    a_serial_lines_bytes_are_counted();
    return 0;
}
