// SPDX-License-Identifier: Apache-2.0
// Cuts moves at the points of the axes' tables. The manual is step_table.h.
#include "coordinator/motion/steps/times/step_table.h"

#include <math.h>
#include <stdlib.h>

static const double TINY = 1e-300;          // keeps 0/0 away
static const double SHORTEST_MM = 1e-5;     // of a piece: what lies closer together is cut once
static const double SHORTEST_FADE_S = 1e-3; // a lag's speed is held to its bound in steps of this at least
enum { FADE_PIECES = 16 };                  // and of this share of a phase

// ------------------------------------------------------------------------------------------- the table

// How many points lie at X or before.
static int points_up_to(const struct axis_table *t, double x) {
    int low = 0, high = t->n;
    while (low < high) {
        const int middle = low + (high - low) / 2;
        if (t->position[middle] <= x)
            low = middle + 1;
        else
            high = middle;
    }
    return low;
}

static double correction(const struct axis_table *t, double x) {
    const double *y = t->side[t->reverse];
    const int next = points_up_to(t, x);
    if (!t->n)
        return 0;
    if (next == 0 || next == t->n)
        return y[next ? next - 1 : 0];
    const double from = t->position[next - 1], share = (x - from) / (t->position[next] - from);
    return y[next - 1] + share * (y[next] - y[next - 1]);
}

void step_table_stand(struct axis_table *t, double position, double offset) {
    t->turn = position;
    t->offset = offset;
    t->lag = offset - correction(t, position);
}

bool step_table_acts(const struct axis_table tables[3]) {
    for (int i = 0; i < 3; i++)
        if (tables[i].n || tables[i].lag != 0)
            return true;
    return false;
}

// ------------------------------------------------------------------------------- way and time of a move

struct course {
    const struct trapezoid *move;
    double end[3]; // s from the move's begin, of each phase
    double way[3]; // mm from the move's begin, at the same
    double end_v;
};

static struct course course_of(const struct trapezoid *m) {
    struct course c = {.move = m, .end = {m->accel_s}, .end_v = fmax(m->cruise_v - m->accel * m->decel_s, 0)};
    c.end[1] = c.end[0] + m->cruise_s;
    c.end[2] = c.end[1] + m->decel_s;
    c.way[0] = (m->start_v + 0.5 * m->accel * m->accel_s) * m->accel_s;
    c.way[1] = c.way[0] + m->cruise_v * m->cruise_s;
    c.way[2] = c.way[1] + (m->cruise_v - 0.5 * m->accel * m->decel_s) * m->decel_s;
    return c;
}

static int phase_at(const struct course *c, double way) {
    return way < c->way[0] ? 0 : way < c->way[1] ? 1 : 2;
}

// As in step_times.c: from the slow end, so that nothing cancels.
static double time_at(const struct course *c, double way) {
    const struct trapezoid *m = c->move;
    switch (phase_at(c, way)) {
    case 0:
        return fmin(2 * way / (m->start_v + sqrt(m->start_v * m->start_v + 2 * m->accel * way) + TINY),
                    c->end[0]);
    case 1:
        return fmin(c->end[0] + (way - c->way[0]) / m->cruise_v, c->end[1]);
    default: {
        const double rest = c->way[2] - way;
        if (!(rest > 0))
            return c->end[2];
        const double left = 2 * rest / (c->end_v + sqrt(c->end_v * c->end_v + 2 * m->accel * rest) + TINY);
        return fmin(fmax(c->end[2] - left, c->end[1]), c->end[2]);
    }
    }
}

static double way_at(const struct course *c, double t) {
    const struct trapezoid *m = c->move;
    if (t < c->end[0])
        return (m->start_v + 0.5 * m->accel * t) * t;
    if (t < c->end[1])
        return c->way[0] + m->cruise_v * (t - c->end[0]);
    const double rest = c->end[2] - t;
    return c->way[2] - (c->end_v + 0.5 * m->accel * rest) * rest;
}

static double speed_at(const struct course *c, double t) {
    const struct trapezoid *m = c->move;
    if (t < c->end[0])
        return m->start_v + m->accel * t;
    return t < c->end[1] ? m->cruise_v : c->end_v + m->accel * (c->end[2] - t);
}

// The part of the move between two times: three phases again, some of which last 0 s.
static struct trapezoid part(const struct course *c, double from, double to) {
    struct trapezoid p = *c->move;
    p.print_time += from;
    p.accel_s = fmax(fmin(to, c->end[0]) - from, 0);
    p.cruise_s = fmax(fmin(to, c->end[1]) - fmax(from, c->end[0]), 0);
    p.decel_s = fmax(to - fmax(from, c->end[1]), 0);
    p.start_v = speed_at(c, from);
    p.cruise_v = from < c->end[1] ? p.cruise_v : speed_at(c, from);
    return p;
}

// ------------------------------------------------------------------------------------------ the next cut

// Where the axis will have turned, or has by now. Returns the way; HUGE_VAL: not in this move.
static double turn_at(const struct axis_table *t, double start, double ratio) {
    const double behind = t->reverse ? STEP_TABLE_TURN_MM : -STEP_TABLE_TURN_MM;
    const bool back = t->reverse ? ratio > 0 : ratio < 0;
    return t->n && back ? (t->turn + behind - start) / ratio : HUGE_VAL;
}

static void change_side(struct axis_table *t, double x) {
    t->lag += correction(t, x);
    t->reverse = !t->reverse;
    t->lag -= correction(t, x);
    t->turn = x;
}

// The way at which the axis passes the next point, at least SHORTEST_MM from here.
static double point_at(const struct axis_table *t, double start, double ratio, double way) {
    if (!t->n || ratio == 0)
        return HUGE_VAL;
    const double x = start + ratio * (way + SHORTEST_MM);
    int next = points_up_to(t, x);
    if (ratio < 0) // the last one before x
        next -= next && t->position[next - 1] == x ? 2 : 1;
    if (next < 0 || next >= t->n)
        return HUGE_VAL;
    return (t->position[next] - start) / ratio;
}

// A lag fades by this many mm per mm of way; TOP: mm/s, the fastest of the piece.
static double fade_per_mm(const struct axis_table *t, double top) {
    return t->lag != 0 ? fmin(1, t->take_up / fmax(top, t->take_up)) : 0;
}

// Where a piece that begins at WAY ends because of the speed at which lags fade.
static double fade_until(const struct course *c, double way) {
    const int phase = phase_at(c, way);
    if (phase == 1)
        return c->way[1];
    const double length_s = phase ? c->move->decel_s : c->move->accel_s;
    const double until = time_at(c, way) + fmax(length_s / FADE_PIECES, SHORTEST_FADE_S);
    return until < c->end[phase] ? way_at(c, until) : c->way[phase];
}

static double next_cut(struct axis_table tables[3], const struct course *c, double way) {
    const struct trapezoid *m = c->move;
    double cut = c->way[2];
    for (int i = 0; i < 3; i++) {
        struct axis_table *t = &tables[i];
        const double turn = turn_at(t, m->start[i], m->ratio[i]);
        if (turn <= way + SHORTEST_MM)
            change_side(t, m->start[i] + m->ratio[i] * way);
        else
            cut = fmin(cut, turn);
        cut = fmin(cut, point_at(t, m->start[i], m->ratio[i], way));
    }
    if (tables[0].lag != 0 || tables[1].lag != 0 || tables[2].lag != 0) {
        cut = fmin(cut, fade_until(c, way));
        const double top = fmax(speed_at(c, time_at(c, way)), speed_at(c, time_at(c, cut)));
        for (int i = 0; i < 3; i++)
            if (tables[i].lag != 0)
                cut = fmin(cut, way + fabs(tables[i].lag) / fade_per_mm(&tables[i], top));
    }
    cut = fmax(cut, way + SHORTEST_MM);
    return c->way[2] - cut < SHORTEST_MM ? c->way[2] : cut;
}

// ------------------------------------------------------------------------------------------- the pieces

// Lets a table follow its axis to X, the lag by FADED mm less; returns what is added there.
static double follow(struct axis_table *t, double x, double faded) {
    t->lag = fabs(t->lag) <= faded * (1 + 1e-9) ? 0 : t->lag - copysign(faded, t->lag);
    t->turn = t->reverse ? fmin(t->turn, x) : fmax(t->turn, x);
    return correction(t, x) + t->lag;
}

// At standstill a lag stays as it is: nothing may move.
static void pass_on(struct axis_table tables[3], const struct trapezoid *m,
                    void (*take)(void *, const struct trapezoid *), void *context) {
    struct trapezoid same = *m;
    for (int i = 0; i < 3; i++)
        same.start[i] += tables[i].offset;
    take(context, &same);
}

void step_table_cut(struct axis_table tables[3], const struct trapezoid *m,
                    void (*take)(void *, const struct trapezoid *), void *context) {
    const struct course c = course_of(m);
    if (!(c.way[2] > 0)) {
        pass_on(tables, m, take, context);
        return;
    }
    double from_s = 0;
    for (double way = 0; way < c.way[2];) {
        const double cut = next_cut(tables, &c, way), to_s = cut < c.way[2] ? time_at(&c, cut) : c.end[2];
        const double top = fmax(speed_at(&c, from_s), speed_at(&c, to_s));
        struct trapezoid piece = part(&c, from_s, to_s);
        for (int i = 0; i < AXES; i++)
            piece.start[i] = m->start[i] + m->ratio[i] * way;
        for (int i = 0; i < 3; i++) {
            struct axis_table *t = &tables[i];
            const double faded = fade_per_mm(t, top) * (cut - way), begin = t->offset;
            t->offset = follow(t, m->start[i] + m->ratio[i] * cut, faded);
            piece.start[i] += begin;
            piece.ratio[i] += (t->offset - begin) / (cut - way);
        }
        take(context, &piece);
        way = cut, from_s = to_s;
    }
}

// Points it passes, turns, ends of lags, phases, and pieces of both ramps that a lag needs, some twice.
int step_table_most_pieces(const struct axis_table tables[3], const struct trapezoid *m) {
    const struct course c = course_of(m);
    int most = 3 * 3 + 2 * FADE_PIECES + 8;
    for (int i = 0; i < 3; i++) {
        const double end = m->start[i] + m->ratio[i] * c.way[2];
        most += abs(points_up_to(&tables[i], end) - points_up_to(&tables[i], m->start[i]));
    }
    return most;
}
