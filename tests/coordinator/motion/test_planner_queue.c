// SPDX-License-Identifier: Apache-2.0
// sources: coordinator/motion/planner/planner_*.c coordinator/motion/planner/gcode_lines.c
// sources: coordinator/motion/planner/gcode_arcs.c
// The hot path and the look-ahead under the sanitizers: random text,
// random moves, every ring and queue edge.
#include "coordinator/motion/planner/gcode_lines.h"
#include "tests/check.h"
#include <math.h>
#include <stdlib.h>
#include <string.h>

static uint32_t random_state = 1;

static uint32_t next_random(uint32_t below) {
    random_state = random_state * 1664525u + 1013904223u;
    return (uint32_t)(((uint64_t)random_state * below) >> 32);
}

static const struct planner_limits LIMITS = {
    .max_velocity = 400,
    .max_accel = 10000,
    .max_z_velocity = 15,
    .max_z_accel = 500,
    .square_corner_velocity = 8,
    .minimum_cruise_ratio = 0.5,
    .position_max = {250, 250, 250},
    .max_extrude_only_velocity = 100,
    .max_extrude_only_accel = 3000,
    .max_extrude_only_distance = 50,
    .max_extrude_ratio = 2,
    .instantaneous_corner_velocity = 1,
};

struct follower {
    double speed, print_time, position[4];
    uint64_t count;
};

// Checks a trapezoid against the one before it.
static void follow(struct follower *f, const struct trapezoid *t) {
    CHECK(t->accel_s >= 0 && t->cruise_s >= 0 && t->decel_s >= 0 && t->accel > 0);
    CHECK(t->print_time == f->print_time);
    CHECK(fabs(t->start_v - f->speed) < 1e-6);
    CHECK(t->cruise_v <= 400 * (1 + 1e-9) && t->accel <= 10000 * (1 + 1e-9));
    double way = t->start_v * t->accel_s + t->accel * t->accel_s * t->accel_s / 2 +
                 t->cruise_v * t->cruise_s + t->cruise_v * t->decel_s -
                 t->accel * t->decel_s * t->decel_s / 2;
    for (int axis = 0; axis < 4; axis++) {
        CHECK(fabs(t->start[axis] - f->position[axis]) < 1e-8);
        f->position[axis] = t->start[axis] + t->ratio[axis] * way;
        CHECK(axis == AXIS_E || (f->position[axis] > -1e-6 && f->position[axis] < 250 + 1e-6));
    }
    f->speed = t->cruise_v - t->accel * t->decel_s;
    f->print_time = t->print_time + (t->accel_s + t->cruise_s + t->decel_s);
    f->count++;
}

static void drain(struct planner *p, struct follower *f, uint32_t most) {
    uint32_t count;
    const struct trapezoid *t = planner_peek(p, &count);
    if (count > most)
        count = most;
    for (uint32_t i = 0; i < count; i++)
        follow(f, &t[i]);
    CHECK_EQUAL(planner_release(p, count), 0);
}

static void finish(struct planner *p, struct follower *f) {
    while (!planner_flush(p))
        drain(p, f, 1 + next_random(PLANNER_RING));
    while (p->ring_head != p->ring_tail)
        drain(p, f, PLANNER_RING);
    CHECK(fabs(f->speed) < 1e-6);
    CHECK_EQUAL(f->count, p->moves_added);
    for (int axis = 0; axis < 4; axis++)
        CHECK(fabs(f->position[axis] - p->position[axis]) < 1e-8);
}

static struct planner planner;

static void begin(struct follower *f, double max_accel) {
    struct planner_limits limits = LIMITS;
    limits.max_accel = max_accel;
    planner_init(&planner, &limits, (const double[4]){0});
    planner.homed = 7;
    *f = (struct follower){0};
}

// Steps of every size, changes of acceleration, trapezoids taken in random portions, flushes anywhere.
static void test_random_moves(double step, double accel) {
    struct follower f;
    begin(&f, accel);
    double target[4] = {125, 125, 10, 0};
    for (int i = 0; i < 60000; i++) {
        for (int axis = 0; axis < 2; axis++)
            if (next_random(3))
                target[axis] = fmin(fmax(target[axis] + step * (next_random(1000) - 400.0) / 1000, 0), 250);
        if (next_random(50) == 0)
            target[2] = next_random(250);
        target[3] += next_random(100) ? 0 : next_random(3) - 1.0;
        if (next_random(500) == 0)
            planner.accel = accel / (1 + next_random(4));
        while (!planner_ready(&planner))
            drain(&planner, &f, 1 + next_random(PLANNER_RING));
        if (planner_add(&planner, target, 1 + next_random(500))) {
            CHECK_EQUAL(planner.fault.kind, PLANNER_EXTRUDE_RATIO);
            target[3] = planner.position[3];
        }
        if (next_random(10000) == 0)
            planner_flush(&planner);
    }
    finish(&planner, &f);
}

static void test_random_text(void) {
    static const char *const TOKENS[] = {"G1 ", "\nG1 ", "\nG0", "\n",   "X1",   "Y2.5",
                                         "Z.",  " E",    "-",    "0.01", "F600", ";",
                                         "(",   ")",     "*7",   "\r\n", "N",    "9999999999"};
    char text[400];
    struct follower f;
    begin(&f, 10000);
    struct gcode_state state = {.unit = 1, .speed = 25, .speed_factor = 1, .extrude_factor = 1};
    for (int round = 0; round < 20000; round++) {
        size_t size = 0, offset = 0;
        for (uint32_t count = next_random(30); count--;) {
            const char *token = TOKENS[next_random(sizeof TOKENS / sizeof *TOKENS)];
            memcpy(text + size, token, strlen(token));
            size += strlen(token);
            if (next_random(20) == 0)
                text[size++] = (char)next_random(256);
        }
        // A copy that ends where its bytes end: reading one byte beyond is a sanitizer's report.
        char *exact = malloc(size + 1);
        CHECK(exact);
        memmove(exact + 1, text, size);
        for (;;) {
            size_t before = offset;
            int status = gcode_feed(&state, &planner, exact + 1, size, &offset, (int)next_random(2));
            CHECK(offset >= before && offset <= size);
            drain(&planner, &f, PLANNER_RING);
            if (status == GCODE_NEED_DATA)
                break;
            const char *eol = memchr(exact + 1 + offset, '\n', size - offset);
            if (!eol)
                break;
            offset = (size_t)(eol + 1 - (exact + 1));
        }
        free(exact);
        for (int axis = 0; axis < 4; axis++)
            CHECK(isfinite(planner.position[axis]));
    }
    CHECK(f.count > 100);
    finish(&planner, &f);
}

static void test_misuse_is_refused(void) {
    struct follower f;
    begin(&f, 10000);
    CHECK_EQUAL(planner_release(&planner, 1), -1);
    CHECK_EQUAL(planner_add(&planner, (const double[4]){NAN, 0, 0, 0}, 10), -1);
    CHECK_EQUAL(planner_add(&planner, (const double[4]){0, 0, 0, NAN}, 10), -1);
    CHECK_EQUAL(planner_add(&planner, (const double[4]){1, 0, 0, NAN}, 10), -1);
    CHECK_EQUAL(planner_add(&planner, (const double[4]){1, 0, 0, INFINITY}, 10), -1);
    CHECK_EQUAL(planner_add(&planner, (const double[4]){1, 0, 0, 0}, NAN), -1);
    CHECK_EQUAL(planner_add(&planner, (const double[4]){1, 0, 0, 0}, 10), 0);
    CHECK_EQUAL(planner_wait(&planner, 1), -1);
    CHECK_EQUAL(planner_begin_at(&planner, 1), -1);
    CHECK_EQUAL(planner_set_position(&planner, (const double[4]){0}), -1);
    finish(&planner, &f);
    CHECK_EQUAL(planner_wait(&planner, NAN), -1);
    CHECK_EQUAL(planner_begin_at(&planner, INFINITY), -1);
}

// Adding without asking planner_ready must not overrun the queue.
static void test_queue_is_bounded(void) {
    struct follower f;
    begin(&f, 10);
    double target[4] = {0};
    for (int i = 0; i < 3 * PLANNER_QUEUE; i++) {
        target[0] += 0.001;
        if (planner_add(&planner, target, 400)) {
            CHECK_EQUAL(planner.fault.kind, PLANNER_NO_FAULT);
            target[0] -= 0.001;
        }
    }
    CHECK(planner.tail - planner.head <= PLANNER_QUEUE);
    finish(&planner, &f);
}

int main(void) {
    test_random_moves(0.02, 10000);
    test_random_moves(1, 5000);
    test_random_moves(0.002, 50);
    test_random_moves(100, 10000);
    test_random_text();
    test_misuse_is_refused();
    test_queue_is_bounded();
    return 0;
}
