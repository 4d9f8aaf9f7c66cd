// SPDX-License-Identifier: Apache-2.0
// One link over memories of its own, its commands, and the answers of its node, in virtual time.
#ifndef LINK_SCENE_H
#define LINK_SCENE_H

#include <string.h>

#include "nodes/link/core/batch.h"
#include "nodes/link/core/link.h"
#include "tests/check.h"

#define MS 1000000ULL
#define SECOND (1000 * MS)
#define NEVER UINT64_MAX

// Sets of classes.
enum { ONLY_MOTION = 1 << LINK_MOTION, ONLY_CONTROL = 1 << LINK_CONTROL, ONLY_BULK = 1 << LINK_BULK };

enum { WINDOW = 192, SCENE_MEMORY = 4096 };

struct scene {
    struct link link;
    struct link_response response; // the last one
    uint64_t now;
    uint8_t out[LINK_WIRE_MAX]; // the last transmission
};

static uint8_t scene_memories[LINK_CLASSES][SCENE_MEMORY];

// A link as it is at first. Nothing in its memory is zero before: whatever it reads it has to write first.
// (As a record, ones are a command of one byte for a moment far away.)
static inline void open_link(struct scene *scene, uint64_t window, uint64_t now) {
    memset(scene, 1, sizeof *scene);
    memset(scene_memories, 1, sizeof scene_memories);
    const struct link_settings settings = {.receive_window = window, .lost_after_ns = SECOND};
    const struct link_memory memories[LINK_CLASSES] = {
        {scene_memories[0], SCENE_MEMORY},
        {scene_memories[1], SCENE_MEMORY},
        {scene_memories[2], SCENE_MEMORY},
    };
    link_init(&scene->link, &settings, memories);
    scene->now = now;
}

// ------------------------------------------------------------------------------------------------ commands

// A command is TAG repeated SIZE times.
static inline enum link_status try_motion(struct scene *scene, char tag, size_t size, uint64_t min_clock,
                                          uint64_t req_clock) {
    uint8_t content[UINT8_MAX], record[BATCH_HEADER + UINT8_MAX];
    memset(content, tag, sizeof content);
    size_t length = batch_write(record, min_clock, req_clock, content, (uint8_t)size);
    return link_send_batch(&scene->link, record, length);
}

static inline void motion(struct scene *scene, char tag, size_t size, uint64_t min_clock,
                          uint64_t req_clock) {
    CHECK_EQUAL(try_motion(scene, tag, size, min_clock, req_clock), LINK_OK);
}

static inline enum link_status try_send(struct scene *scene, enum link_class kind, char tag, size_t size,
                                        uint64_t min_clock, uint64_t req_clock) {
    uint8_t content[UINT8_MAX];
    memset(content, tag, sizeof content);
    return link_send(&scene->link, kind, content, size, min_clock, req_clock, scene->now);
}

static inline void control(struct scene *scene, char tag, size_t size) {
    CHECK_EQUAL(try_send(scene, LINK_CONTROL, tag, size, 0, 0), LINK_OK);
}

static inline void bulk(struct scene *scene, char tag, size_t size) {
    CHECK_EQUAL(try_send(scene, LINK_BULK, tag, size, 0, 0), LINK_OK);
}

static inline enum link_status urgent(struct scene *scene, char tag, size_t size) {
    uint8_t content[UINT8_MAX];
    memset(content, tag, sizeof content);
    return link_send_urgent(&scene->link, content, size, scene->now);
}

// ---------------------------------------------------------------------------------------------- both ways

static inline size_t go_of(struct scene *scene, unsigned allowed) {
    memset(scene->out, 0xEE, sizeof scene->out);
    return link_next_block(&scene->link, scene->now, allowed, scene->out);
}

static inline size_t go(struct scene *scene) {
    return go_of(scene, LINK_ALL);
}

// Checks the last transmission: LEAD bytes, of which the last is a sync byte (before contact: all of them),
// and one block with CONTENT.
static inline void check_block(const struct scene *scene, size_t size, size_t lead, const char *content) {
    size_t length = strlen(content);
    CHECK_EQUAL(size, lead + WIRE_BLOCK_MIN + length);
    for (size_t i = 0; i < lead; i++)
        CHECK_EQUAL(scene->out[i],
                    scene->link.state == LINK_RUNNING && lead > 1 && i + 1 < lead ? 0 : WIRE_SYNC);
    for (size_t i = 0; i < length; i++)
        CHECK_EQUAL(scene->out[lead + WIRE_HEADER + i], content[i]);
    uint8_t whole[WIRE_BLOCK_MAX];
    memcpy(whole + WIRE_HEADER, content, length);
    wire_block_finish(whole, length, scene->out[lead + 1]);
    CHECK(memcmp(whole, scene->out + lead, WIRE_BLOCK_MIN + length) == 0);
}

// Checks the last transmission: after LEAD bytes one block with CONTENT, and that block once more behind as
// many sync bytes as bring it, and one of them, into a frame of their own.
static inline void check_twice(const struct scene *scene, size_t size, size_t lead, const char *content) {
    size_t length = WIRE_BLOCK_MIN + strlen(content), copy = size - length;
    check_block(scene, lead + length, lead, content);
    CHECK_EQUAL(copy % 8, 1);
    CHECK(copy > lead + length && copy < lead + length + 8);
    for (size_t i = lead + length; i < copy; i++)
        CHECK_EQUAL(scene->out[i], WIRE_SYNC);
    CHECK(memcmp(scene->out + copy, scene->out + lead, length) == 0);
}

// CONTENT goes now, in one new block; nothing: no block.
static inline void check_goes(struct scene *scene, const char *content) {
    check_block(scene, go(scene), 0, content);
}

// SIZE bytes come; returns how many responses they hold.
static inline unsigned comes(struct scene *scene, const uint8_t *data, size_t size) {
    for (unsigned found = 0;; found++) {
        struct link_response response;
        memset(&response, 0xEE, sizeof response); // what was there is not looked at
        if (!link_receive(&scene->link, &data, &size, scene->now, &response)) {
            CHECK_EQUAL(size, 0);
            return found;
        }
        scene->response = response;
    }
}

// The node says that it expects SEQUENCE, with a response of SIZE bytes; 0: with nothing.
static inline unsigned answer(struct scene *scene, uint64_t sequence, size_t size) {
    uint8_t block[WIRE_BLOCK_MAX];
    memset(block, 'r', sizeof block);
    return comes(scene, block, wire_block_finish(block, size, (unsigned)sequence));
}

// All that was sent arrived.
static inline void acknowledge_all(struct scene *scene) {
    answer(scene, scene->link.next, 0);
}

// From the start to a running link with nothing in flight; each question takes ROUND_TRIP_NS.
static inline void run_up(struct scene *scene, uint64_t round_trip_ns) {
    control(scene, 'u', 1);
    for (int i = 0; i < 3; i++) {
        CHECK(go(scene) > 0);
        scene->now += round_trip_ns;
        acknowledge_all(scene);
    }
    CHECK_EQUAL(scene->link.state, LINK_RUNNING);
    CHECK_EQUAL(link_pending(&scene->link), 0);
}

static inline void open_running(struct scene *scene, uint64_t window) {
    open_link(scene, window, SECOND);
    run_up(scene, 0);
}

static inline struct link_stats stats_of(const struct scene *scene) {
    struct link_stats stats;
    link_get_stats(&scene->link, &stats);
    return stats;
}

static inline uint64_t deadline_of(const struct scene *scene) {
    return link_deadline(&scene->link, scene->now, LINK_ALL);
}

// What would go now: its class, time and urgency; nothing: LINK_CLASSES.
struct offered {
    unsigned kind, urgent;
    uint64_t due_ns;
};

static inline struct offered offer_of(const struct scene *scene, unsigned allowed) {
    struct link_offer offer;
    memset(&offer, 0xEE, sizeof offer);
    if (!link_next_offer(&scene->link, scene->now, allowed, &offer))
        return (struct offered){.kind = LINK_CLASSES};
    return (struct offered){offer.kind, offer.urgent, offer.due_ns};
}

#define CHECK_OFFER(scene, kind_, due_ns_, urgent_)                                                          \
    do {                                                                                                     \
        struct offered offered_ = offer_of(scene, LINK_ALL);                                                 \
        CHECK_EQUAL(offered_.kind, kind_);                                                                   \
        CHECK_EQUAL(offered_.due_ns, due_ns_);                                                               \
        CHECK_EQUAL(offered_.urgent, urgent_);                                                               \
    } while (0)

#endif
