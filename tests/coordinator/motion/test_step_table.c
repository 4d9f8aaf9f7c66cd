// SPDX-License-Identifier: Apache-2.0
// sources: coordinator/motion/steps/times/step_table.c
// Moves cut at the points of tables: the pieces join, last as long as the move, and end where the table says.
#include "coordinator/motion/steps/times/step_table.h"
#include "tests/check.h"

#include <math.h>
#include <stdint.h>
#include <string.h>

enum { POINTS = 200, PIECES = 4096 };
static const double TAKE_UP = 5;

static double position[POINTS], forward[POINTS], reverse[POINTS];
static struct trapezoid pieces[PIECES];
static int count;

static void take(void *context, const struct trapezoid *piece) {
    CHECK(context == pieces);
    CHECK(count < PIECES);
    pieces[count++] = *piece;
}

static uint32_t state = 1;

static double random_in(double low, double high) {
    state = state * 1664525u + 1013904223u;
    return low + (high - low) * (double)(state >> 8) / (double)(1 << 24);
}

static double way_of(const struct trapezoid *m) {
    return (m->start_v + 0.5 * m->accel * m->accel_s) * m->accel_s + m->cruise_v * m->cruise_s +
           (m->cruise_v - 0.5 * m->accel * m->decel_s) * m->decel_s;
}

static double seconds_of(const struct trapezoid *m) {
    return m->accel_s + m->cruise_s + m->decel_s;
}

static double fastest_of(const struct trapezoid *m) {
    const double first = m->accel_s > 0 ? m->start_v + m->accel * m->accel_s : m->cruise_v;
    return m->cruise_s > 0 ? fmax(first, m->cruise_v) : first;
}

// What the table says, searched from the front.
static double said(const double *side, double x) {
    if (x <= position[0])
        return side[0];
    for (int i = 1; i < POINTS; i++)
        if (x <= position[i])
            return side[i - 1] +
                   (x - position[i - 1]) / (position[i] - position[i - 1]) * (side[i] - side[i - 1]);
    return side[POINTS - 1];
}

static struct axis_table make_table(double step) {
    double at = random_in(-20, 0);
    for (int i = 0; i < POINTS; i++) {
        at += random_in(0.01, 2 * step);
        position[i] = at;
        forward[i] = i ? forward[i - 1] + random_in(-0.02, 0.02) * (at - position[i - 1]) : 0.01;
        reverse[i] = forward[i] - 0.03;
    }
    return (struct axis_table){
        .n = POINTS, .position = position, .side = {forward, reverse}, .take_up = TAKE_UP};
}

static struct trapezoid make_move(const double start[4]) {
    struct trapezoid m = {.print_time = random_in(0, 1000), .accel = random_in(100, 5000)};
    const double top = random_in(1, 300);
    m.start_v = random_in(0, 1) < 0.5 ? 0 : random_in(0, top);
    m.cruise_v = top;
    m.accel_s = (top - m.start_v) / m.accel;
    m.cruise_s = random_in(0, 1) < 0.2 ? 0 : random_in(0, 0.5);
    m.decel_s = random_in(0, 1) < 0.5 ? top / m.accel : random_in(0, top / m.accel);
    memcpy(m.start, start, sizeof(m.start));
    for (int i = 0; i < 4; i++)
        m.ratio[i] = random_in(0, 1) < 0.2 ? 0 : random_in(-1, 1);
    return m;
}

// The pieces follow each other in time and place, and none is faster than the move, its slopes and its lag.
static void check_pieces(const struct trapezoid *m, const double *begin) {
    double time = m->print_time, way = 0, at[4];
    memcpy(at, begin, sizeof(at));
    for (int k = 0; k < count; k++) {
        const struct trapezoid *p = &pieces[k];
        CHECK(p->accel_s >= 0 && p->cruise_s >= 0 && p->decel_s >= 0 && p->start_v >= 0);
        CHECK(p->cruise_v - p->accel * p->decel_s >= -1e-6);
        CHECK(fabs(p->print_time - time) < 1e-9);
        for (int i = 0; i < 4; i++) {
            CHECK(fabs(p->start[i] - at[i]) < 1e-9);
            at[i] = p->start[i] + p->ratio[i] * way_of(p);
        }
        const double extra = fabs(p->ratio[0] - m->ratio[0]) - 0.021;
        CHECK(extra <= 1 + 1e-6);
        CHECK(extra * fastest_of(p) <= TAKE_UP * (1 + 1e-6) + 1e-3);
        CHECK(p->ratio[3] == m->ratio[3]);
        time = p->print_time + seconds_of(p);
        way += way_of(p);
    }
    CHECK(fabs(time - m->print_time - seconds_of(m)) < 1e-9);
    CHECK(fabs(way - way_of(m)) < 1e-8);
}

static void random_moves(double step) {
    for (int run = 0; run < 200; run++) {
        struct axis_table tables[3] = {make_table(step)};
        double planned[4] = {random_in(-10, 100), 1, 2, 3}, motor[4];
        memcpy(motor, planned, sizeof(motor));
        step_table_stand(&tables[0], planned[0], 0);
        for (int i = 0; i < 20; i++) {
            const struct trapezoid m = make_move(planned);
            count = 0;
            const int most = step_table_most_pieces(tables, &m);
            step_table_cut(tables, &m, take, pieces);
            CHECK(count >= 1 && count <= most);
            check_pieces(&m, motor);
            for (int j = 0; j < 4; j++) {
                planned[j] += m.ratio[j] * way_of(&m);
                motor[j] =
                    pieces[count - 1].start[j] + pieces[count - 1].ratio[j] * way_of(&pieces[count - 1]);
            }
            const double *side = tables[0].reverse ? reverse : forward;
            CHECK(fabs(motor[0] - planned[0] - said(side, planned[0]) - tables[0].lag) < 1e-9);
            CHECK(fabs(motor[0] - planned[0] - tables[0].offset) < 1e-9);
            CHECK(fabs(motor[1] - planned[1]) < 1e-9 && fabs(motor[3] - planned[3]) < 1e-9);
        }
    }
}

// One way and back by X, from standstill to standstill.
static void go(struct axis_table *tables, double from, double way) {
    const struct trapezoid m = {.accel_s = 0.1,
                                .decel_s = 0.1,
                                .accel = fabs(way) / 0.01,
                                .cruise_v = fabs(way) / 0.1,
                                .start = {from},
                                .ratio = {way > 0 ? 1 : -1}};
    count = 0;
    step_table_cut(tables, &m, take, pieces);
}

static void turns(void) {
    struct axis_table tables[3] = {make_table(1)};
    step_table_stand(&tables[0], 50, said(forward, 50));
    CHECK(fabs(tables[0].lag) < 1e-12);
    go(tables, 50, 1);
    CHECK(tables[0].reverse == 0 && tables[0].lag == 0);
    for (int i = 0; i < 100; i++) { // to and fro by less than a turn: nothing changes
        go(tables, 51, -0.0009);
        CHECK(tables[0].reverse == 0);
        go(tables, 51 - 0.0009, 0.0009);
        CHECK(tables[0].reverse == 0 && tables[0].lag == 0);
    }
    go(tables, 51, -0.0009); // many short moves turn it as well as a long one
    go(tables, 51 - 0.0009, -0.0009);
    CHECK(tables[0].reverse == 1);
    CHECK(fabs(tables[0].lag - 0.03) < 0.002);
    const double lag = tables[0].lag;
    const struct trapezoid still = {.start = {51 - 0.0018}};
    count = 0;
    step_table_cut(tables, &still, take, pieces);
    CHECK(count == 1 && tables[0].lag == lag);
    go(tables, 51 - 0.0018, -1);
    CHECK(tables[0].lag == 0 && tables[0].reverse == 1);
}

static void acting(void) {
    struct axis_table tables[3] = {{.take_up = TAKE_UP}};
    CHECK(!step_table_acts(tables));
    step_table_stand(&tables[2], 0, 0.1); // without a table any more
    tables[2].take_up = TAKE_UP;
    CHECK(step_table_acts(tables));
    go(tables, 0, 20);
    CHECK(!step_table_acts(tables) && tables[2].offset == 0);
    CHECK(fabs(pieces[count - 1].start[2]) < 1e-12);
}

int main(void) {
    random_moves(0.5);
    random_moves(0.02);
    turns();
    acting();
    return 0;
}
