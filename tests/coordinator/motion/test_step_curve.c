// SPDX-License-Identifier: Apache-2.0
// sources: coordinator/motion/steps/step*.c coordinator/motion/steps/*/*.c coordinator/kinematics/*.c
// sources: firmware/wire/vlq.c
// Shaped, smoothed and non-linear steppers under the sanitizers: many moves without drift, changes at rest.
#include "coordinator/motion/steps/steps.h"
#include "tests/check.h"

#include <math.h>
#include <stdlib.h>

enum { MOVES = 30000 };
enum { SHAPED, DELTA, SMOOTHED, ANGLE, STEPPERS };
extern const struct step_formula formula_delta, formula_polar_angle;
static const struct step_stepper_config steppers[STEPPERS] = {
    [SHAPED] = {0, 0, NULL, {1, 1, 0, 0}, {0}, 0.02, 0, 2e-6},
    [DELTA] = {0, 1, &formula_delta, {0}, {62500, 90, -50}, 0.02, 0, 2e-6},
    [SMOOTHED] = {0, 2, NULL, {0, 0, 0, 1}, {0}, 0.004, 0, 2e-6},
    [ANGLE] = {0, 3, &formula_polar_angle, {0}, {0}, 0.002, 0, 2e-6},
};
static const struct step_node_config nodes[] = {{64e6, 4096, 11, 12, 13}};
static const double start[AXES] = {30, 20, 5, 0};

static void generate(struct step_gen *gen, double until, int flush) {
    static uint8_t out[1 << 16];
    for (int status = STEP_FULL; status == STEP_FULL;) {
        status = step_generate(gen, until, flush);
        CHECK(status == STEP_OK || status == STEP_FULL);
        while (step_take_batch(gen, 0, out, sizeof(out)))
            ;
    }
}

// Moves X, Y and E to and fro by WAY (mm of X); returns the move's end.
static double play(struct step_gen *gen, double time, double position[AXES], double way) {
    struct trapezoid m = {.print_time = time, .accel = 4000, .pressure_advance = 0.03};
    m.ratio[AXIS_X] = way > 0 ? 0.6 : -0.6;
    m.ratio[AXIS_Y] = 0.8;
    m.ratio[AXIS_Y] *= way > 0 ? -1 : 1;
    m.ratio[AXIS_E] = 0.05;
    m.accel_s = m.decel_s = sqrt(fabs(way) / 0.6 / m.accel);
    m.cruise_v = m.accel * m.accel_s;
    for (int i = 0; i < AXES; i++) {
        m.start[i] = position[i];
        position[i] += m.ratio[i] * m.cruise_v * m.accel_s;
    }
    CHECK_EQUAL(step_append(gen, &m, 1), 1);
    return time + 2 * m.accel_s;
}

static int64_t done(const struct step_gen *gen, int stepper) {
    struct step_stepper_stats s;
    step_stepper_stats(gen, stepper, &s);
    CHECK_EQUAL(s.position, s.issued);
    CHECK(s.worst_error_s <= 12.5e-6 * 1.001);
    return s.position;
}

static double delta(const double *p) {
    return (p[2] + sqrt(62500 - (90 - p[0]) * (90 - p[0]) - (-50 - p[1]) * (-50 - p[1]))) / 0.02;
}

// On a boundary either side will do.
static void check_place(const struct step_gen *gen, int stepper, double place) {
    CHECK(fabs((double)done(gen, stepper) - place) <= 0.5 + 1e-4);
}

static void check_places(const struct step_gen *gen, const double *p) {
    check_place(gen, SHAPED, (p[0] + p[1] - start[0] - start[1]) / 0.02);
    check_place(gen, DELTA, delta(p) - delta(start));
    check_place(gen, SMOOTHED, (p[3] - start[3]) / 0.004);
    check_place(gen, ANGLE, (atan2(p[1], p[0]) - atan2(start[1], start[0])) / 0.002);
}

static struct step_gen *shaped(void *memory, const struct step_config *c) {
    const double amplitude[] = {0.25, 0.5, 0.25}, time_s[] = {-0.01, 0, 0.01};
    struct step_gen *gen = step_gen_init(memory, c);
    CHECK(gen);
    CHECK_EQUAL(step_set_shaper(gen, AXIS_X, 3, amplitude, time_s), STEP_OK);
    CHECK_EQUAL(step_set_smooth_time(gen, SMOOTHED, 0.04), STEP_OK);
    return gen;
}

int main(void) {
    const struct step_config c = {STEPPERS, 1, steppers, nodes, 12.5e-6, {30, 20, 5, 0}, 0};
    void *memory = malloc(step_gen_size(&c));
    struct step_gen *gen = shaped(memory, &c);
    double at[AXES] = {30, 20, 5, 0}, time = step_next_move(gen);
    for (int i = 0; i < MOVES; i++) {
        const double way = (i & 1 ? -1 : 1) * (0.2 + 0.001 * (i >> 1 & 63));
        time = play(gen, time, at, way);
        if (i % 1000 == 999) { // a flush in the middle
            generate(gen, time + step_lag(gen), 1);
            check_places(gen, at);
            time = step_next_move(gen);
        } else if (i % 20 == 19) {
            generate(gen, time, 0);
        }
    }
    // What is at rest may change: no step by that, and what comes is counted from there.
    const int64_t before = done(gen, SHAPED);
    CHECK_EQUAL(step_set_weights(gen, SHAPED, (const double[]){0, 1, 0, 0}), STEP_OK);
    CHECK_EQUAL(done(gen, SHAPED), before);
    const double elsewhere[AXES] = {-40, 30, 7, 1}, was = at[AXIS_E];
    CHECK_EQUAL(step_set_axis_position(gen, elsewhere), STEP_OK);
    int64_t old[STEPPERS];
    for (int i = 0; i < STEPPERS; i++)
        old[i] = done(gen, i);
    for (int i = 0; i < AXES; i++)
        at[i] = elsewhere[i];
    CHECK(fabs(was - elsewhere[AXIS_E]) > 0.01);
    time = play(gen, step_next_move(gen), at, 10);
    CHECK_EQUAL(step_set_weights(gen, SHAPED, (const double[]){1, 0, 0, 0}), STEP_NOT_IDLE);
    generate(gen, time + step_lag(gen), 1);
    check_place(gen, SHAPED, (double)old[SHAPED] + (at[1] - elsewhere[1]) / 0.02);
    check_place(gen, DELTA, (double)old[DELTA] + delta(at) - delta(elsewhere));
    check_place(gen, SMOOTHED, (double)old[SMOOTHED] + (at[3] - elsewhere[3]) / 0.004);
    free(memory);
    return 0;
}
