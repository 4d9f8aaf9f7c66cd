// SPDX-License-Identifier: Apache-2.0
// sources: firmware/wire/*.c nodes/link/core/link*.c nodes/link/core/queue.c
// The link against bytes and calls that make no sense: nothing faults, nothing is unbounded, time goes on.
#include "tests/check.h"

#include <math.h>
#include <string.h>

#include "nodes/link/core/batch.h"
#include "nodes/link/core/link.h"

static uint8_t control_memory[512], motion_memory[2048], bulk_memory[1024];

static uint32_t random_bits(uint32_t *state) {
    *state ^= *state << 13;
    *state ^= *state >> 17;
    *state ^= *state << 5;
    return *state;
}

static struct link fresh(uint64_t window) {
    struct link link;
    struct link_settings settings = {.receive_window = window, .lost_after_ns = 1000000000};
    const struct link_memory memories[LINK_CLASSES] = {
        [LINK_MOTION] = {motion_memory, sizeof motion_memory},
        [LINK_CONTROL] = {control_memory, sizeof control_memory},
        [LINK_BULK] = {bulk_memory, sizeof bulk_memory},
    };
    link_init(&link, &settings, memories);
    return link;
}

// Bytes that are mostly noise, often sound blocks, and now and then cut ones.
static size_t make_input(uint8_t *out, uint32_t *state) {
    size_t size = random_bits(state) % 60;
    for (size_t i = 0; i < size; i++)
        out[i] = (uint8_t)(random_bits(state) % 7 ? random_bits(state) : WIRE_SYNC);
    if (random_bits(state) % 2) {
        size = wire_block_finish(out, random_bits(state) % 3 ? 0 : size % 60, random_bits(state));
        size -= random_bits(state) % 8 ? 0 : random_bits(state) % size;
    }
    return size;
}

static void feed(struct link *link, uint64_t now, uint32_t *state) {
    uint8_t input[WIRE_BLOCK_MAX];
    const uint8_t *at = input;
    size_t size = make_input(input, state);
    struct link_response response;
    while (link_receive(link, &at, &size, now, &response)) {
        CHECK(response.size >= 1 && response.size <= WIRE_CONTENT_MAX);
        CHECK(response.sent_ns <= now);
    }
    CHECK_EQUAL(size, 0);
    CHECK(link->rx_used < WIRE_BLOCK_MAX);
}

static void command(struct link *link, uint64_t now, uint32_t *state) {
    uint8_t bytes[3 * (BATCH_HEADER + 70)];
    for (size_t i = 0; i < sizeof bytes; i++)
        bytes[i] = (uint8_t)random_bits(state);
    size_t size = 0;
    uint64_t clock = random_bits(state) % 4 ? now / 10 + random_bits(state) % 1000000 : random_bits(state);
    switch (random_bits(state) % 16) {
    case 0:
        link_send_urgent(link, bytes, random_bits(state) % 64, now);
        break;
    case 1:
        link_send_batch(link, bytes, random_bits(state) % sizeof bytes);
        break;
    case 2:
        link_set_clock(link, 1e8, now, now / 10);
        break;
    case 3:
        link_set_receive_window(link, random_bits(state) % 1000);
        break;
    case 4:
        link_send(link, random_bits(state) % 3 ? LINK_CONTROL : LINK_BULK, bytes, random_bits(state) % 64,
                  random_bits(state) % 3 ? 0 : clock, clock, now);
        break;
    default:
        for (int i = 0; i < 3; i++)
            size += batch_write(bytes + size, random_bits(state) % 2 ? 0 : clock, clock, bytes + 150,
                                (uint8_t)(1 + random_bits(state) % 20));
        link_send_batch(link, bytes, size);
    }
}

static void check_bounds(const struct link *link, uint64_t now) {
    CHECK(link->first <= link->cursor && link->cursor <= link->next);
    CHECK(link->next - link->first <= LINK_BLOCKS_MAX);
    CHECK(link_queue_bytes(&link->queues[LINK_CONTROL]) <= sizeof control_memory);
    CHECK(link_queue_bytes(&link->queues[LINK_MOTION]) <= sizeof motion_memory);
    CHECK(link_queue_bytes(&link->queues[LINK_BULK]) <= sizeof bulk_memory);
    CHECK(link_pending(link) <= sizeof control_memory + sizeof motion_memory + sizeof bulk_memory);
    for (unsigned allowed = 0; allowed <= LINK_ALL; allowed++)
        CHECK(link_deadline(link, now, allowed) > now);
}

static void survives_garbage(void) {
    for (uint32_t seed = 1; seed <= 300; seed++) {
        uint32_t state = seed * 2654435761u;
        struct link link = fresh(64 + seed);
        uint64_t now = 1;
        for (int i = 0; i < 1500 && link.state != LINK_LOST; i++) {
            now += random_bits(&state) % 3000000;
            feed(&link, now, &state);
            command(&link, now, &state);
            struct link_response response;
            const uint8_t *nothing = NULL;
            size_t none = 0;
            while (link_receive(&link, &nothing, &none, now, &response))
                ;
            link_handle_timer(&link, now);
            uint8_t out[LINK_WIRE_MAX];
            size_t size;
            while ((size = link_next_block(
                        &link, now, random_bits(&state) % 4 ? LINK_ALL : random_bits(&state) % 8, out)) != 0)
                CHECK(size >= WIRE_BLOCK_MIN && size <= LINK_WIRE_MAX && out[size - 1] == WIRE_SYNC);
            check_bounds(&link, now);
        }
    }
}

static void refuses_what_makes_no_sense(void) {
    struct link link = fresh(192);
    uint8_t bytes[64] = {1};
    CHECK_EQUAL(link_send(&link, LINK_CONTROL, bytes, 0, 0, 0, 0), LINK_INVALID);
    CHECK_EQUAL(link_send(&link, LINK_CONTROL, bytes, 60, 0, 0, 0), LINK_INVALID);
    CHECK_EQUAL(link_send(&link, LINK_MOTION, bytes, 1, 0, 0, 0), LINK_INVALID);
    CHECK_EQUAL(link_send_batch(&link, bytes, 16), LINK_INVALID);
    CHECK_EQUAL(link_send_batch(&link, bytes, 17), LINK_INVALID); // a record without a command
    CHECK_EQUAL(link_set_receive_window(&link, 63), LINK_INVALID);
    CHECK_EQUAL(link_set_clock(&link, NAN, 0, 0), LINK_INVALID);
    CHECK_EQUAL(link_set_clock(&link, INFINITY, 0, 0), LINK_INVALID);
    CHECK_EQUAL(link_set_clock(&link, 0, 0, 0), LINK_INVALID);
    CHECK_EQUAL(link_pending(&link), 0);
    CHECK(link_deadline(&link, 0, LINK_ALL) == UINT64_MAX);
}

static void a_full_queue_refuses_and_keeps_what_it_has(void) {
    struct link link = fresh(192);
    uint8_t bytes[59] = {1};
    unsigned taken = 0;
    while (link_send(&link, LINK_CONTROL, bytes, sizeof bytes, 0, 0, 0) == LINK_OK)
        taken++;
    CHECK_EQUAL(taken, sizeof control_memory / (BATCH_HEADER + 8 + sizeof bytes));
    CHECK_EQUAL(link_pending(&link), taken);
    CHECK_EQUAL(link_send_urgent(&link, bytes, 3, 0), LINK_OK);
    CHECK_EQUAL(link_pending(&link), 1);
    CHECK_EQUAL(link.stats.commands_dropped, taken);
}

// Extreme clocks saturate: they neither overflow nor become due by wrapping around.
static void extreme_clocks_wait(void) {
    struct link link = fresh(192);
    link.state = LINK_RUNNING;
    uint8_t out[LINK_WIRE_MAX], bytes[] = {4};
    CHECK_EQUAL(link_set_clock(&link, 1e-3, 1000, 1000), LINK_OK);
    CHECK_EQUAL(link_send(&link, LINK_CONTROL, bytes, 1, UINT64_MAX, UINT64_MAX, 0), LINK_OK);
    CHECK_EQUAL(link_next_block(&link, UINT64_MAX / 2, LINK_ALL, out), 0);
    CHECK(link_deadline(&link, 5, LINK_ALL) == UINT64_MAX);
    struct link_offer offer;
    CHECK(!link_next_offer(&link, 5, LINK_ALL, &offer));
}

// This computer stands still for five seconds with one block on its way: it asks again before it judges.
// A node that answers was never lost; one that stays silent is, within the usual time.
static void a_host_that_stood_still_asks_first(void) {
    const uint64_t stall_ns = 5000000000, lost_after_ns = 1000000000;
    for (int answers = 0; answers < 2; answers++) {
        struct link link = fresh(192);
        uint8_t out[LINK_WIRE_MAX], bytes[] = {4};
        uint64_t now = 1, repeats = 0;
        CHECK_EQUAL(link_send(&link, LINK_CONTROL, bytes, 1, 0, 0, now), LINK_OK);
        CHECK(link_next_block(&link, now, LINK_ALL, out) > 0);
        now += stall_ns;
        for (unsigned sequence = 0; link.state != LINK_LOST && link_pending(&link); sequence++) {
            link_handle_timer(&link, now);
            while (link_next_block(&link, now, LINK_ALL, out))
                repeats++;
            if (answers) {
                uint8_t answer[WIRE_BLOCK_MAX];
                const uint8_t *at = answer;
                size_t size = wire_block_finish(answer, 0, sequence);
                struct link_response response;
                while (link_receive(&link, &at, &size, now, &response))
                    ;
                link_next_block(&link, now, LINK_ALL, out);
            }
            now = link_deadline(&link, now, LINK_ALL);
        }
        CHECK((link.state == LINK_LOST) == !answers);
        CHECK(answers || (repeats > 2 && now > stall_ns + lost_after_ns / 2));
        CHECK(answers || link.cause == LINK_CAUSE_SILENT);
    }
}

int main(void) {
    a_host_that_stood_still_asks_first();
    refuses_what_makes_no_sense();
    a_full_queue_refuses_and_keeps_what_it_has();
    extreme_clocks_wait();
    survives_garbage();
    return 0;
}
