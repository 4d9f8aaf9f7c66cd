// SPDX-License-Identifier: Apache-2.0
// sources: coordinator/motion/steps/step*.c coordinator/motion/steps/*/*.c coordinator/kinematics/*.c
// sources: firmware/wire/vlq.c
// What step generation refuses, and that a refused call changes nothing.
#include "coordinator/motion/steps/steps.h"
#include "tests/check.h"

#include <math.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

extern const struct step_formula formula_winch;
static const struct step_stepper_config steppers[] = {
    {0, 0, NULL, {1, 0, 0, 0}, {0}, 0.01, 0, 2e-6},
    {1, 1, &formula_winch, {0, 0, 0, 0}, {-100, 0, 500}, 0.01, 0, 2e-6},
};
static const struct step_node_config nodes[] = {{168e6, 512, 11, 200, -3}, {16e6, 512, 11, 12, 13}};
static const struct step_config config = {2, 2, steppers, nodes, 12.5e-6, {0, 0, 0, 0}, 0};
static const double start[4] = {1, 2, 3, 4}, zeros[4];
static const double rising[] = {0, 10, 20}, even[] = {0, 0, 0}, falling[] = {0, 20, 10};

static struct step_gen *begin(void) {
    void *memory = malloc(step_gen_size(&config));
    struct step_gen *gen = step_gen_init(memory, &config);
    CHECK(gen);
    CHECK_EQUAL(step_set_axis_position(gen, start), STEP_OK);
    return gen;
}

static struct trapezoid move(void) {
    return (struct trapezoid){.print_time = 1,
                              .accel_s = 0.1,
                              .cruise_s = 0.1,
                              .decel_s = 0.1,
                              .cruise_v = 10,
                              .accel = 100,
                              .start = {1, 2, 3, 4},
                              .ratio = {1, 0, 0, 0}};
}

// The move's steps, in the clock and with the correction that were set last.
static void check_it_still_works(struct step_gen *gen) {
    const struct trapezoid m = move();
    CHECK_EQUAL(step_append(gen, &m, 1), 1);
    CHECK_EQUAL(step_generate(gen, 2, 1), STEP_OK);
    struct step_stepper_stats stats;
    step_stepper_stats(gen, 0, &stats);
    CHECK_EQUAL(stats.steps, 200);
    CHECK_EQUAL(stats.position, 200);
    free(gen);
}

static void bad_numbers_are_refused(void) {
    struct step_gen *gen = begin();
    const double bad[] = {NAN, INFINITY, -INFINITY, 1e300};
    for (size_t i = 0; i < sizeof(bad) / sizeof(*bad); i++) {
        const double one = 1, position[4] = {0, 0, 0, bad[i]}, table[] = {0, bad[i], 20};
        CHECK_EQUAL(step_set_axis_position(gen, position), STEP_BAD_CONFIG);
        CHECK_EQUAL(step_set_clock_base(gen, 0, bad[i], 0, 168e6), STEP_BAD_CLOCK);
        CHECK_EQUAL(step_set_clock_base(gen, 0, 0, 0, bad[i]), STEP_BAD_CLOCK);
        CHECK_EQUAL(step_set_clock(gen, 0, bad[i]), STEP_BAD_CLOCK);
        CHECK_EQUAL(step_set_shaper(gen, 0, 1, &bad[i], &zeros[0]), STEP_BAD_CONFIG);
        CHECK_EQUAL(step_set_shaper(gen, 0, 1, &one, &bad[i]), STEP_BAD_CONFIG);
        CHECK_EQUAL(step_set_weights(gen, 0, position), STEP_BAD_CONFIG);
        CHECK_EQUAL(step_set_smooth_time(gen, 0, bad[i]), STEP_BAD_CONFIG);
        CHECK_EQUAL(step_set_table(gen, 0, 3, table, even, even, 1), STEP_BAD_CONFIG);
        CHECK_EQUAL(step_set_table(gen, 0, 3, rising, table, even, 1), STEP_BAD_CONFIG);
        CHECK_EQUAL(step_set_table(gen, 0, 3, rising, even, table, 1), STEP_BAD_CONFIG);
        CHECK_EQUAL(step_set_table(gen, 0, 3, rising, even, even, bad[i]), STEP_BAD_CONFIG);
    }
    check_it_still_works(gen);
}

static void what_there_is_not_is_refused(void) {
    struct step_gen *gen = begin();
    const double one = 1, two[] = {0.5, 0.6}, times[] = {-0.01, 0.01}, late = 0.01;
    struct step_correction correction;
    uint8_t out[60] = {0};
    for (int at = -1; at <= 2; at += 3) {
        CHECK_EQUAL(step_set_clock_base(gen, at, 0, 0, 168e6), STEP_BAD_CLOCK);
        CHECK_EQUAL(step_set_clock(gen, at, 168e6), STEP_BAD_CLOCK);
        CHECK_EQUAL(step_set_weights(gen, at, zeros), STEP_BAD_CONFIG);
        CHECK_EQUAL(step_set_smooth_time(gen, at, 0.02), STEP_BAD_CONFIG);
        CHECK_EQUAL(step_take_batch(gen, at, out, sizeof(out)), 0);
    }
    CHECK_EQUAL(step_set_weights(gen, 1, zeros), STEP_BAD_CONFIG); // a winch has none
    for (int axis = -1; axis <= 3; axis += 4) {
        CHECK_EQUAL(step_set_shaper(gen, axis, 1, &one, zeros), STEP_BAD_CONFIG);
        CHECK_EQUAL(step_set_table(gen, axis, 3, rising, even, even, 1), STEP_BAD_CONFIG);
        CHECK_EQUAL(step_get_correction(gen, axis, &correction), STEP_BAD_CONFIG);
    }
    CHECK_EQUAL(step_set_clock_base(gen, 0, 0, -1, 168e6), STEP_BAD_CLOCK);
    CHECK_EQUAL(step_set_shaper(gen, 0, 0, &one, zeros), STEP_BAD_CONFIG);
    CHECK_EQUAL(step_set_shaper(gen, 0, STEP_IMPULSES + 1, &one, zeros), STEP_BAD_CONFIG);
    CHECK_EQUAL(step_set_shaper(gen, 0, 2, two, times), STEP_BAD_CONFIG);  // more than 1 in all
    CHECK_EQUAL(step_set_shaper(gen, 0, 1, &one, &late), STEP_BAD_CONFIG); // not centred
    CHECK_EQUAL(step_set_smooth_time(gen, 0, 0.99e-6 * STEP_SMOOTH_MIN_US), STEP_BAD_CONFIG);
    CHECK_EQUAL(step_set_smooth_time(gen, 0, 1.01e-6 * STEP_SMOOTH_MAX_US), STEP_BAD_CONFIG);
    CHECK_EQUAL(step_set_table(gen, 0, 1, rising, even, even, 1), STEP_BAD_CONFIG);
    CHECK_EQUAL(step_set_table(gen, 0, STEP_TABLE_POINTS + 1, rising, even, even, 1), STEP_BAD_CONFIG);
    CHECK_EQUAL(step_set_table(gen, 0, 3, falling, even, even, 1), STEP_BAD_CONFIG);
    CHECK_EQUAL(step_set_table(gen, 0, 3, rising, even, even, 0), STEP_BAD_CONFIG);
    check_it_still_works(gen);
}

// While a move waits to be generated nothing may change that it was planned with.
static void nothing_changes_under_a_move(void) {
    struct step_gen *gen = begin();
    const struct trapezoid m = move();
    const double one = 1;
    const int32_t forward[3] = {0};
    CHECK_EQUAL(step_append(gen, &m, 1), 1);
    CHECK_EQUAL(step_set_axis_position(gen, start), STEP_NOT_IDLE);
    CHECK_EQUAL(step_set_corrections(gen, zeros, forward), STEP_NOT_IDLE);
    CHECK_EQUAL(step_set_table(gen, 0, 3, rising, even, even, 1), STEP_NOT_IDLE);
    CHECK_EQUAL(step_set_shaper(gen, 0, 1, &one, zeros), STEP_NOT_IDLE);
    CHECK_EQUAL(step_set_weights(gen, 0, zeros), STEP_NOT_IDLE);
    CHECK_EQUAL(step_set_smooth_time(gen, 0, 0.02), STEP_NOT_IDLE);
    CHECK_EQUAL(step_generate(gen, 2, 1), STEP_OK);
    struct step_stepper_stats stats;
    step_stepper_stats(gen, 0, &stats);
    CHECK_EQUAL(stats.position, 200);
    CHECK_EQUAL(step_set_table(gen, 0, 3, rising, even, even, 1), STEP_OK);
    free(gen);
}

// The first error stays: what was generated after it would be in no order.
static void an_error_stays(void) {
    struct step_gen *gen = begin();
    CHECK_EQUAL(step_generate(gen, NAN, 0), STEP_BAD_ORDER);
    CHECK_EQUAL(step_generate(gen, 2, 1), STEP_BAD_ORDER);
    struct step_error error;
    step_last_error(gen, &error);
    CHECK_EQUAL(error.status, STEP_BAD_ORDER);
    CHECK_EQUAL(error.stepper, -1);
    free(gen);
}

int main(void) {
    bad_numbers_are_refused();
    what_there_is_not_is_refused();
    nothing_changes_under_a_move();
    an_error_stays();
    return 0;
}
