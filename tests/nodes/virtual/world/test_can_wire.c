// SPDX-License-Identifier: Apache-2.0
// sources: nodes/support/can_bits.c nodes/virtual/world/agenda.c nodes/virtual/world/c*.c
// The wire under the sanitizers: everything that can happen
// to it, at random, and what must hold whatever it was.
#include "tests/check.h"

#include <string.h>

#include "nodes/virtual/world/can_wire.h"

enum { CONTROLLERS = 12, ROUNDS = 60000, QUEUE = 5 };

struct bench {
    struct agenda agenda;
    struct can_wire wire;
    struct can_controller controllers[CONTROLLERS];
    uint64_t heard, left;
};

static void on_frame(void *owner, const struct can_bits *frame) {
    struct bench *bench = owner;
    CHECK(frame->size <= 8 && frame->id <= 0x7FF);
    bench->heard++;
}

static void on_sent(void *owner) {
    ((struct bench *)owner)->left++;
}

static void start(struct bench *bench, uint64_t seed) {
    const struct can_wire_settings settings = {.bitrate = 500000, .bit_errors = 2e-4};
    memset(bench, 0, sizeof(*bench));
    CHECK(can_wire_start(&bench->wire, &bench->agenda, chance_of(seed, CHANCE_WIRE, 0), &settings) == 0);
    for (uint32_t i = 0; i < CONTROLLERS; i++) {
        bench->controllers[i] = (struct can_controller){
            .settings = {.queue = QUEUE,
                         .reserved = i % 3,
                         .mailboxes = 1 + i % 3,
                         .loss = 0.01,
                         .corruption = 0.01,
                         .restart_ns = i % 4 ? 0 : UINT64_MAX,
                         .drops_when_off = i % 2},
            .chance = chance_of(seed, CHANCE_NODE, i),
            .owner = bench,
            .on_frame = on_frame,
            .on_sent = on_sent,
        };
        CHECK(can_wire_join(&bench->wire, &bench->controllers[i]) == 0);
    }
}

static struct can_bits any_frame(struct chance *chance) {
    struct can_bits frame = {.id = (uint32_t)chance_below(chance, 8) * 0x55,
                             .size = (uint8_t)chance_below(chance, 9)};
    for (int i = 0; i < frame.size; i++)
        frame.data[i] = (uint8_t)chance_bits(chance);
    return frame;
}

static void act(struct bench *bench, struct chance *chance) {
    struct can_controller *controller = &bench->controllers[chance_below(chance, CONTROLLERS)];
    struct can_bits frame = any_frame(chance);
    switch (chance_below(chance, 40)) {
    case 0:
        can_power(controller, 0);
        break;
    case 1:
    case 2:
        can_power(controller, 1);
        break;
    case 3:
        can_clear(controller);
        break;
    case 4:
        can_cut(controller, (uint32_t)chance_below(chance, CAN_SEGMENTS_MAX));
        break;
    case 5:
        can_restart(controller);
        break;
    case 6:
        can_babble(controller, &frame, bench->agenda.now_ns + chance_below(chance, 2000000));
        break;
    case 7:
    case 8:
    case 9:
        can_cut(controller, 0);
        break;
    default:
        can_offer(controller, &frame);
    }
}

static void check_invariants(const struct bench *bench) {
    for (int i = 0; i < CONTROLLERS; i++) {
        const struct can_controller *controller = &bench->controllers[i];
        CHECK(controller->count <= QUEUE);
        CHECK(controller->rec <= 128);
        CHECK(controller->off == (controller->tec >= 256));
        CHECK(!controller->recovering || controller->off);
    }
    const struct can_wire_counters *counters = &bench->wire.counters;
    CHECK_EQUAL(counters->errors, counters->collisions + counters->disturbed + counters->unacknowledged);
}

static uint64_t run(uint64_t seed) {
    static struct bench bench;
    struct chance chance = chance_of(seed, CHANCE_PYTHON, 9);
    start(&bench, seed);
    for (int round = 0; round < ROUNDS; round++) {
        act(&bench, &chance);
        uint64_t until_ns = bench.agenda.now_ns + chance_below(&chance, 400000);
        while (agenda_step(&bench.agenda, until_ns))
            check_invariants(&bench);
        bench.agenda.now_ns = until_ns;
    }
    const struct can_wire_counters *counters = &bench.wire.counters;
    CHECK(counters->frames > 1000 && counters->collisions > 100 && counters->disturbed > 100);
    CHECK(counters->unacknowledged > 100 && counters->yielded > 0 && bench.heard > counters->frames);
    uint64_t trace = bench.agenda.trace;
    for (int i = 0; i < CONTROLLERS; i++)
        can_controller_free(&bench.controllers[i]);
    agenda_free(&bench.agenda);
    return trace;
}

int main(void) {
    uint64_t first = run(1);
    CHECK(run(1) == first);
    CHECK(run(2) != first);
    return 0;
}
