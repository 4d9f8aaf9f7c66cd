// SPDX-License-Identifier: Apache-2.0
// sources: coordinator/motion/steps/step*.c coordinator/motion/steps/*/*.c coordinator/kinematics/*.c
// sources: firmware/wire/vlq.c
// Step generation under the sanitizers: memory of exactly the promised size, hostile numbers, random moves.
#include "coordinator/motion/steps/steps.h"
#include "nodes/link/core/batch.h"
#include "tests/check.h"
#include "wire/wire.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

static const struct step_stepper_config steppers[] = {
    {0, 0, NULL, {1, 1, 0, 0}, {0}, 0.00625, 0, 2e-6},
    {0, 1, NULL, {1, -1, 0, 0}, {0}, 0.00625, 1, 2e-6},
    {1, 2, NULL, {0, 0, 0, 1}, {0}, 0.0014, 0, 0},
};
static const struct step_node_config nodes[] = {{168e6, 5, 11, 200, -3}, {16e6, 1024, 11, 12, 13}};

static struct step_config config(void) {
    return (struct step_config){3, 2, steppers, nodes, 12.5e-6, {0, 0, 0, 0}, 0};
}

static uint32_t state = 1;

static double random_between(double low, double high) {
    state = state * 1664525u + 1013904223u;
    return low + (high - low) * (double)(state >> 8) / (double)(1 << 24);
}

// A move of two ramps from START to the other end in *START.
static struct trapezoid next_move(double time, double start[4]) {
    struct trapezoid m = {.print_time = time, .accel = random_between(100, 9000)};
    double way = 0;
    for (int i = 0; i < 4; i++) {
        m.start[i] = start[i];
        start[i] = i == 2 ? 0 : random_between(-3, 3);
        way += i < 3 ? (start[i] - m.start[i]) * (start[i] - m.start[i]) : 0;
    }
    way = sqrt(way);
    for (int i = 0; i < 4; i++)
        m.ratio[i] = (start[i] - m.start[i]) / way;
    m.cruise_v = fmin(sqrt(m.accel * way), 100 / (1 + fabs(m.ratio[3])));
    m.accel_s = m.decel_s = m.cruise_v / m.accel;
    m.cruise_s = (way - m.cruise_v * m.accel_s) / m.cruise_v;
    m.cruise_s = m.cruise_s > 0 ? m.cruise_s : 0;
    return m;
}

static size_t drain(struct step_gen *gen, size_t room) {
    uint8_t out[300];
    size_t records = 0;
    for (int node = 0; node < 2; node++)
        for (size_t size; (size = step_take_batch(gen, node, out, room));) {
            struct batch_record record;
            for (size_t at = 0, whole; at < size; at += whole, records++) {
                whole = batch_read(out + at, size - at, &record);
                CHECK(whole && record.size && record.size < WIRE_CONTENT_MAX);
            }
        }
    return records;
}

static void random_moves_in_random_pieces(void) {
    const struct step_config c = config();
    void *memory = malloc(step_gen_size(&c));
    memset(memory, 0xA5, step_gen_size(&c)); // init has to set all it relies on
    struct step_gen *gen = step_gen_init(memory, &c);
    CHECK(gen);
    double time = 1, at[4] = {0, 0, 0, 0};
    uint64_t records = 0;
    for (int i = 0; i < 300; i++) {
        const struct trapezoid m = next_move(time, at);
        CHECK_EQUAL(step_append(gen, &m, 1), 1);
        time += m.accel_s + m.cruise_s + m.decel_s;
        const double until = time - random_between(0, 0.05);
        int status;
        while ((status = step_generate(gen, until, random_between(0, 1) < 0.2)) == STEP_FULL)
            records += drain(gen, 300);
        CHECK_EQUAL(status, STEP_OK);
        if (i % 7 == 0)
            CHECK_EQUAL(step_set_clock(gen, 1, random_between(15.99e6, 16.01e6)), STEP_OK);
        if (i % 5 == 0)
            records += drain(gen, 60);
        time = fmax(time, until) + (i % 11 ? 0 : random_between(0, 20));
    }
    while (step_generate(gen, time, 1) == STEP_FULL)
        records += drain(gen, 300);
    records += drain(gen, 300);
    uint64_t counted = 0, most = 0;
    for (int i = 0; i < 3; i++) {
        struct step_stepper_stats s;
        step_stepper_stats(gen, i, &s);
        CHECK_EQUAL(s.position, s.issued);
        CHECK(s.worst_error_s <= 12.5e-6 * 1.001);
        counted += s.commands;
        most = s.steps > most ? s.steps : most;
    }
    CHECK_EQUAL(records, counted);
    CHECK(most > 10000);
    free(memory);
}

static void illegal_configurations(void) {
    struct step_config c = config();
    CHECK(step_gen_size(&c) > 0);
    struct step_stepper_config bad[3];
    const double numbers[] = {NAN, INFINITY, -1, 0};
    for (size_t i = 0; i < 4; i++) {
        memcpy(bad, steppers, sizeof(bad));
        bad[1].step_distance = numbers[i];
        c = config();
        c.steppers = bad;
        CHECK_EQUAL(step_gen_size(&c), 0);
        c = config();
        c.max_error_s = numbers[i];
        CHECK_EQUAL(step_gen_size(&c), 0);
    }
    memcpy(bad, steppers, sizeof(bad));
    bad[2].node = 2;
    c.steppers = bad;
    c.max_error_s = 1e-5;
    CHECK_EQUAL(step_gen_size(&c), 0);
    c = config();
    c.stepper_count = STEP_MAX_STEPPERS + 1;
    CHECK_EQUAL(step_gen_size(&c), 0);
    c = config();
    c.node_count = 0;
    CHECK_EQUAL(step_gen_size(&c), 0);
}

// Whatever stands in a move: a status, never a fault.
static void hostile_moves(void) {
    static const double odd[] = {NAN, INFINITY, -INFINITY, 1e308, -1e308, 1e-308, -1, 0, 1e9, 999999999};
    const struct step_config c = config();
    void *memory = malloc(step_gen_size(&c));
    for (size_t field = 0; field < sizeof(struct trapezoid) / sizeof(double); field++)
        for (size_t i = 0; i < sizeof(odd) / sizeof(*odd); i++) {
            struct step_gen *gen = step_gen_init(memory, &c);
            struct trapezoid m = {.print_time = 1,
                                  .accel_s = 0.01,
                                  .cruise_s = 0.01,
                                  .decel_s = 0.01,
                                  .cruise_v = 10,
                                  .accel = 1000,
                                  .ratio = {0.6, 0.8, 0, 0}};
            double number = odd[i];
            memcpy((char *)&m + field * sizeof(double), &number, sizeof(number));
            if (step_append(gen, &m, 1) != 1)
                continue;
            for (int turns = 0; turns < 100 && step_generate(gen, 2, 1) == STEP_FULL; turns++)
                drain(gen, 300);
        }
    free(memory);
}

int main(void) {
    random_moves_in_random_pieces();
    illegal_configurations();
    hostile_moves();
    return 0;
}
