// SPDX-License-Identifier: Apache-2.0
// A bus and a node that answers when it is told to, in virtual time.
#ifndef BUS_SCENE_H
#define BUS_SCENE_H

#include <linux/can.h>
#include <string.h>

#include "nodes/link/io/io_api.h"
#include "nodes/support/can_bits.h"
#include "tests/check.h"

#define MS 1000000ULL

enum { NODE = 4, LAST_NODE = 255, DATA_ID = 0x100, TO_PYTHON_ID = 0x3F1, FRAME = sizeof(struct can_frame) };

static const struct io_settings full_speed = {.bitrate = 1000000};
static const struct link_settings usual = {.receive_window = 192, .lost_after_ns = 5000 * MS};

struct scene {
    struct io_bus *bus;
    enum io_kind kind;
    uint32_t link;
    unsigned node; // whose id the link has
    uint64_t now_ns;
    uint8_t heard[1024]; // what the node has of the stream
    size_t heard_size;
    struct wire_scanner scanner;
    unsigned expected; // the node's next sequence
    unsigned blocks;   // that the node took
    int notices;       // that the program was given
};

static inline uint64_t now_of(void *context) {
    return ((struct scene *)context)->now_ns;
}

static inline void nothing(void *context) {
    (void)context;
}

static inline void count_notice(void *context) {
    ((struct scene *)context)->notices++;
}

static inline uint16_t id_of(unsigned node) {
    return (uint16_t)(DATA_ID + 2 * node);
}

static inline void open(struct scene *scene, enum io_kind kind, unsigned node,
                        const struct io_settings *settings) {
    static const struct io_driver driver = {now_of, nothing, nothing, nothing, count_notice, NULL};
    *scene = (struct scene){.now_ns = 1000 * MS, .kind = kind, .node = node};
    scene->bus = io_new(kind, settings, &driver, scene);
    CHECK(scene->bus);
    CHECK_EQUAL(io_open_link(scene->bus, kind == IO_BYTES ? 0 : node, &usual, &scene->link), IO_OK);
}

static inline void frame_comes(struct scene *scene, uint32_t can_id, const uint8_t *data, size_t size) {
    struct can_frame frame = {.can_id = can_id, .can_dlc = (uint8_t)size};
    memcpy(frame.data, data, size);
    io_received(scene->bus, (const uint8_t *)&frame, FRAME, scene->now_ns);
}

// The node answers; CONTENT of SIZE 0: an acknowledgement.
static inline void answer(struct scene *scene, const uint8_t *content, size_t size) {
    uint8_t block[WIRE_BLOCK_MAX] = {0};
    if (size)
        memcpy(block + WIRE_HEADER, content, size);
    size_t length = wire_block_finish(block, size, scene->expected);
    if (scene->kind == IO_BYTES)
        io_received(scene->bus, block, length, scene->now_ns);
    else
        for (size_t at = 0; at < length; at += 8)
            frame_comes(scene, id_of(scene->node) + 1u, block + at, length - at < 8 ? length - at : 8);
    io_handle_time(scene->bus, scene->now_ns);
}

static inline void node_hears(struct scene *scene, const uint8_t *data, size_t size) {
    CHECK(scene->heard_size + size <= sizeof scene->heard);
    memcpy(scene->heard + scene->heard_size, data, size);
    scene->heard_size += size;
    size_t skip, length;
    for (;;) {
        enum wire_scan found = wire_scan(&scene->scanner, scene->heard, scene->heard_size, &skip, &length);
        CHECK(found != WIRE_LOST || scene->heard[0] == 0); // the filler before a repeat
        if (found == WIRE_BLOCK && (scene->heard[skip + 1] & WIRE_SEQ_MASK) == (uint8_t)scene->expected) {
            scene->expected = (scene->expected + 1) & WIRE_SEQ_MASK;
            scene->blocks++;
        }
        scene->heard_size -= skip + length;
        memmove(scene->heard, scene->heard + skip + length, scene->heard_size);
        if (found == WIRE_MORE)
            return;
    }
}

// What goes now, in rounds of ROOM bytes; the node hears it. Returns how many bytes or frames went.
static inline size_t pump(struct scene *scene, size_t room) {
    uint8_t out[IO_OUT_FRAMES * FRAME];
    size_t size, sent = 0;
    while ((size = io_next(scene->bus, scene->now_ns, IO_QUEUED_UNKNOWN, out, room)) > 0) {
        CHECK(size <= room);
        if (scene->kind == IO_BYTES) {
            node_hears(scene, out, size);
            sent += size;
            continue;
        }
        CHECK_EQUAL(size % FRAME, 0);
        for (size_t at = 0; at < size; at += FRAME) {
            struct can_frame frame;
            memcpy(&frame, out + at, FRAME);
            sent++;
            if (frame.can_id == id_of(scene->node))
                node_hears(scene, frame.data, frame.can_dlc);
        }
    }
    return sent;
}

static inline void send_control(struct scene *scene, size_t size) {
    static const uint8_t content[WIRE_CONTENT_MAX] = {5};
    CHECK_EQUAL(io_send(scene->bus, scene->link, LINK_CONTROL, content, size, 0, 0), IO_OK);
}

// First contact, and a first command; nothing is in flight then.
static inline void run_up(struct scene *scene) {
    send_control(scene, 1);
    for (unsigned blocks = 1; blocks <= 3; blocks++) {
        pump(scene, IO_OUT_FRAMES * FRAME);
        CHECK_EQUAL(scene->blocks, blocks);
        scene->now_ns += 10 * MS;
        answer(scene, NULL, 0);
    }
    CHECK_EQUAL(pump(scene, IO_OUT_FRAMES * FRAME), 0);
}

static inline struct io_stats bus_stats(struct scene *scene) {
    struct io_stats stats;
    uint8_t out[IO_OUT_FRAMES * FRAME];
    io_next(scene->bus, scene->now_ns, IO_QUEUED_UNKNOWN, out, sizeof out); // publishes
    io_get_stats(scene->bus, &stats);
    return stats;
}

static inline struct io_link_stats link_stats(struct scene *scene) {
    struct io_link_stats stats;
    CHECK_EQUAL(io_get_link_stats(scene->bus, scene->link, &stats), IO_OK);
    return stats;
}

#endif
