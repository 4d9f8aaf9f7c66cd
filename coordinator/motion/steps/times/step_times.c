// SPDX-License-Identifier: Apache-2.0
// When a stepper's steps are due: closed forms on the phases of each move.
//
// In a phase of constant acceleration the way from its slow end is x = v·τ + a·τ²/2 with a >= 0 (a
// deceleration is looked at from its end, backwards), so τ = 2x / (v + √(v² + 2·a·x)): all terms are
// positive, nothing cancels, and every step stands for itself.
#include "coordinator/motion/steps/step_internal.h"

static const double JUMP_STEPS = 0.01; // how far a move may begin from where the last one ended
static const double FURTHEST_STEPS = 1e12;
static const double TINY = 1e-300; // keeps 0/0 away

static double mix(const double *weights, const double *values) {
    return weights[0] * values[0] + weights[1] * values[1] + weights[2] * values[2] + weights[3] * values[3];
}

int64_t step_settle(double u, int64_t position) {
    const double tie = 1.0 / STEP_TIE;
    const int64_t up = (int64_t)floor(u + 0.5 - tie);
    if (up > position)
        return up;
    const int64_t down = (int64_t)ceil(u - 0.5 + tie);
    return down < position ? down : position;
}

static void split(const struct trapezoid *m, struct phase phase[3]) {
    const double accel_way = (m->start_v + 0.5 * m->accel * m->accel_s) * m->accel_s;
    const double cruise_way = m->cruise_v * m->cruise_s;
    const double end_v = fmax(m->cruise_v - m->accel * m->decel_s, 0);
    phase[0] = (struct phase){m->print_time, m->accel_s, 0, accel_way, m->start_v, m->accel, false, NULL};
    phase[1] = (struct phase){
        m->print_time + m->accel_s, m->cruise_s, accel_way, cruise_way, m->cruise_v, 0, false, NULL};
    phase[2] = (struct phase){m->print_time + m->accel_s + m->cruise_s,
                              m->decel_s,
                              accel_way + cruise_way,
                              (m->cruise_v - 0.5 * m->accel * m->decel_s) * m->decel_s,
                              end_v,
                              m->accel,
                              true,
                              NULL};
}

static double way_at(const struct phase *p, double time) {
    const double t = time - p->time, rest = p->seconds - t;
    if (p->backwards)
        return p->from + p->way - (p->speed + 0.5 * p->accel * rest) * rest;
    return p->from + (p->speed + 0.5 * p->accel * t) * t;
}

// Ticks of COUNT steps, the first at X mm from the phase's begin, the others DX apart. Writes whole blocks.
STEP_VECTOR
static void fill(const struct phase *p, const struct clock_map *clock, int64_t base, double x, double dx,
                 size_t count, double *out) {
    enum { BLOCK = FILL_BLOCK };
    const double rate = clock->ticks_per_s;
    const double origin = clock_relative(clock, p->backwards ? p->time + p->seconds : p->time, base);
    if (p->solved) {
        const double *t = p->solved + (size_t)x;
        for (size_t i = 0; i < count; i += BLOCK)
            for (size_t j = 0; j < BLOCK; j++)
                out[i + j] = origin + t[i + j] * rate;
        return;
    }
    if (p->accel == 0) {
        const double scale = rate / p->speed;
        for (size_t i = 0; i < count; i += BLOCK)
            for (int j = 0; j < BLOCK; j++)
                out[i + (size_t)j] = origin + (x + (double)(int32_t)(i + (size_t)j) * dx) * scale;
        return;
    }
    const double first = p->backwards ? p->way - x : x, step = p->backwards ? -dx : dx;
    const double v = p->speed, vv = v * v, twice = 2 * p->accel, sign = p->backwards ? -2 * rate : 2 * rate;
    for (size_t i = 0; i < count; i += BLOCK)
        for (int j = 0; j < BLOCK; j++) {
            double y = first + (double)(int32_t)(i + (size_t)j) * step;
            y = y > 0 ? y : 0;
            out[i + (size_t)j] = origin + sign * y / (v + __builtin_sqrt(vv + twice * y) + TINY);
        }
}

// Measures the waiting steps, and the last one sent, from a new base; exact, because it moves whole ticks.
void step_rebase(struct stepper *s, int64_t base) {
    const double shift = (double)(base - s->base);
    s->base = base;
    s->sent_ticks -= shift;
    for (size_t i = 0; i < s->count; i++)
        s->ticks[i] -= shift;
}

// Turns the stepper round before a step due at TICKS. *CANCELLED: that step and the waiting one annul each
// other.
static int turn(struct step_gen *gen, struct stepper *s, double ticks, bool *cancelled) {
    *cancelled = ticks - s->ticks[s->count - 1] < s->closest_ticks;
    if (*cancelled) {
        s->count--;
        s->stats.cancelled += 2;
        return STEP_OK;
    }
    return step_compress(gen, s, s->count, ticks, HUGE_VAL);
}

// Room in the buffer for at least one step.
static int make_room(struct step_gen *gen, struct stepper *s) {
    if (s->count < STEP_BUFFER)
        return STEP_OK;
    const double next = s->ticks[s->count - 1];
    int status = step_compress(gen, s, s->count - 1, next, -HUGE_VAL);
    if (!status && s->count == STEP_BUFFER)
        status = step_compress(gen, s, s->count - 1, next, HUGE_VAL);
    return status;
}

// After a flush the stepper may turn within the time its pulses need: such steps come late, not never.
static void put_off(struct stepper *s, int direction, size_t count) {
    double earliest = s->sent_ticks + s->closest_ticks;
    if (s->sent_direction != -direction)
        return;
    for (size_t i = 0; i < count && s->ticks[i] < earliest; i++) {
        s->ticks[i] = earliest;
        earliest += s->closest_ticks;
        s->stats.put_off++;
    }
}

int step_put(struct step_gen *gen, struct stepper *s, const struct phase *p, int direction, double x,
             double dx, int64_t count) {
    for (int64_t done = 0; done < count;) {
        const double at = x + (double)done * dx;
        if (s->count && s->direction != direction) {
            double first[BUFFER_PAD];
            bool cancelled;
            fill(p, s->clock, s->base, at, dx, 1, first);
            const int status = turn(gen, s, first[0], &cancelled);
            if (status)
                return status;
            if (cancelled) {
                s->position += direction;
                done++;
                continue;
            }
        }
        const int status = make_room(gen, s);
        if (status)
            return status;
        const bool empty = s->count == 0;
        if (empty)
            step_rebase(s, (int64_t)floor(clock_relative(s->clock, p->time, 0)));
        s->direction = direction;
        const int64_t room = (int64_t)(STEP_BUFFER - s->count),
                      batch = count - done < room ? count - done : room;
        fill(p, s->clock, s->base, at, dx, (size_t)batch, s->ticks + s->count);
        s->count += (size_t)batch;
        if (empty)
            put_off(s, direction, s->count);
        s->position += direction * batch;
        done += batch;
    }
    return STEP_OK;
}

// The position in DIRECTION up to LIMIT that the stepper has reached at U.
static int64_t reached(double u, int direction, int64_t limit) {
    const int64_t n = (int64_t)floor(u + 0.5);
    return (n - limit) * direction > 0 ? limit : n;
}

// Appends the steps of one move that are due before UNTIL and not yet there.
static int play(struct step_gen *gen, struct stepper *s, const struct trapezoid *m, double until) {
    const double *weights = s->config.weights, distance = s->config.step_distance;
    const double begin = mix(weights, m->start) / distance - s->origin;
    const double ratio = mix(weights, m->ratio) / distance;
    if (ratio == 0)
        return STEP_OK;
    struct phase phase[3];
    split(m, phase);
    const double way = phase[2].from + phase[2].way;
    const double end_mm[AXES] = {m->start[0] + m->ratio[0] * way, m->start[1] + m->ratio[1] * way,
                                 m->start[2] + m->ratio[2] * way, m->start[3] + m->ratio[3] * way};
    const double end = mix(weights, end_mm) / distance - s->origin;
    if (!(fabs(begin) < FURTHEST_STEPS && fabs(end) < FURTHEST_STEPS))
        return step_fail(gen, STEP_BAD_MOVE, s, m->print_time, end);
    const int direction = ratio > 0 ? 1 : -1;
    const int64_t target = step_settle(end, s->position);
    int last = 2;
    while (last > 0 && !(phase[last].way > 0))
        last--;
    for (int i = 0; i <= last; i++) {
        const struct phase *p = &phase[i];
        const double p_end = p->time + p->seconds;
        if (p->time >= until && !is_over(p_end, until))
            break;
        if (!(p->way > 0))
            continue;
        int64_t to = target;
        if (!is_over(p_end, until))
            to = reached(begin + ratio * way_at(p, until), direction, target);
        else if (i < last)
            to = reached(begin + ratio * (p->from + p->way), direction, target);
        const int64_t count = (to - s->position) * direction;
        if (count <= 0)
            continue;
        const double boundary = (double)s->position + 0.5 * direction;
        // A tie's width behind, it was passed by the move before.
        const double x = fmax((boundary - begin) / ratio - p->from, 0);
        const int status = step_put(gen, s, p, direction, x, 1 / fabs(ratio), count);
        if (status)
            return status;
    }
    return STEP_OK;
}

// A move has to begin where the stepper stands; checked before its first step.
static int check_begin(struct step_gen *gen, const struct stepper *s, const struct trapezoid *m) {
    const double begin = mix(s->config.weights, m->start) / s->config.step_distance - s->origin;
    const double off = begin - (double)s->position;
    if (fabs(off) <= 0.5 + JUMP_STEPS)
        return STEP_OK;
    return step_fail(gen, STEP_JUMP, s, m->print_time, off);
}

int step_times_advance(struct step_gen *gen, struct stepper *s, double until) {
    for (; s->move < gen->moves_to; s->move++) {
        const struct trapezoid *m = step_move(gen, s->move);
        if (m->print_time >= until && !is_over(move_end(m), until))
            break;
        int status = STEP_OK;
        if (s->begun != s->move + 1) {
            status = check_begin(gen, s, m);
            s->begun = s->move + 1;
        }
        if (!status)
            status = play(gen, s, m, until);
        if (status)
            return status;
        if (!is_over(move_end(m), until))
            break;
    }
    return STEP_OK;
}
