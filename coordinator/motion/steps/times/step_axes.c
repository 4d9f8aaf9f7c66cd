// SPDX-License-Identifier: Apache-2.0
// Where the axes are planned to be at a time, and through which taps a stepper sees them.
#include "coordinator/motion/steps/step_internal.h"

#include <string.h>

static double length_of(const struct trapezoid *m) {
    return (m->start_v + 0.5 * m->accel * m->accel_s) * m->accel_s + m->cruise_v * m->cruise_s +
           (m->cruise_v - 0.5 * m->accel * m->decel_s) * m->decel_s;
}

void step_move_end_position(const struct trapezoid *m, double *position) {
    const double way = length_of(m);
    for (int i = 0; i < AXES; i++)
        position[i] = m->start[i] + m->ratio[i] * way;
}

void step_end_position(const struct step_gen *gen, double *position) {
    if (gen->kept_from == gen->moves_to)
        memcpy(position, gen->rest, sizeof(gen->rest));
    else
        step_move_end_position(step_move(gen, gen->moves_to - 1), position);
}

static void locate_rest(const struct step_gen *gen, uint64_t cursor, struct motion *out) {
    static const double NO_WAY[AXES] = {0};
    const double border = cursor < gen->moves_to ? step_move(gen, cursor)->print_time : HUGE_VAL;
    if (cursor == gen->kept_from) {
        *out = (struct motion){.from = gen->rest, .ratio = NO_WAY, .border = border};
        return;
    }
    const struct trapezoid *m = step_move(gen, cursor - 1);
    *out = (struct motion){.from = m->start, .ratio = m->ratio, .way = length_of(m), .border = border};
}

void step_locate(const struct step_gen *gen, uint64_t *cursor, double time, struct motion *out) {
    *cursor = *cursor < gen->kept_from ? gen->kept_from : *cursor;
    while (*cursor < gen->moves_to && is_over(move_end(step_move(gen, *cursor)), time))
        ++*cursor;
    const struct trapezoid *m = step_move(gen, *cursor);
    if (*cursor == gen->moves_to || m->print_time > time + ROUNDING_S) {
        locate_rest(gen, *cursor, out);
        return;
    }
    double t = time - m->print_time, way = 0, speed = m->start_v, accel = m->accel;
    out->border = m->print_time + m->accel_s;
    if (is_over(out->border, time)) {
        way = (m->start_v + 0.5 * m->accel * m->accel_s) * m->accel_s;
        t = time - out->border, speed = m->cruise_v, accel = 0;
        const double border = m->print_time + m->accel_s + m->cruise_s;
        if (is_over(border, time)) {
            way += m->cruise_v * m->cruise_s;
            t = time - border, accel = -m->accel;
        }
        out->border = accel == 0 && !is_over(border, time) ? border : move_end(m);
    }
    out->from = m->start, out->ratio = m->ratio;
    out->way = way + (speed + 0.5 * accel * t) * t;
    out->speed = speed + accel * t, out->accel = accel;
    out->pressure_advance = m->pressure_advance;
}

// What was seen of the moves does not hold any more.
void step_forget(struct stepper *s) {
    for (int i = 0; i < STEP_TAPS + 3; i++)
        s->seen[i].border = -HUGE_VAL;
    s->trusted = 0;
    s->passed = 0;
}

static void add_tap(struct step_gen *gen, int axis, double amplitude, double time) {
    int i = 0;
    while (i < gen->tap_count && gen->taps[i].time != time)
        i++;
    if (i == gen->tap_count)
        gen->taps[gen->tap_count++] = (struct tap){.time = time};
    gen->taps[i].amplitude[axis] += amplitude;
    gen->taps[i].axes |= 1u << axis;
}

// Axes with equal shapers share their taps.
void step_make_taps(struct step_gen *gen) {
    gen->tap_count = 0;
    add_tap(gen, AXIS_E, 1, 0);
    for (int axis = AXIS_X; axis <= AXIS_Z; axis++)
        for (int i = 0; i < gen->shapers[axis].n; i++)
            add_tap(gen, axis, gen->shapers[axis].amplitude[i], gen->shapers[axis].time[i]);
}

static unsigned axes_used(const struct step_stepper_config *config) {
    if (config->formula)
        return config->formula->axes;
    unsigned axes = 0;
    for (int i = 0; i < AXES; i++)
        axes |= config->weights[i] != 0 ? 1u << i : 0;
    return axes;
}

// One move after the other is the fast way; it does for linear steppers of axes as planned.
void step_choose_way(struct step_gen *gen, struct stepper *s) {
    step_forget(s);
    s->uses = axes_used(&s->config);
    s->follows_bed = gen->surface.grid.points_x && s->uses & STEP_USES_Z;
    s->uses |= s->follows_bed ? STEP_USES_X | STEP_USES_Y : 0;
    const bool smooth = s->smooth_s > 0 && s->uses & USES_E;
    s->reach = s->lag = smooth ? s->smooth_s / 2 : 0;
    s->between = s->follows_bed && !s->config.formula;
    s->curve = smooth || s->config.formula || s->follows_bed;
    for (int i = 0; i < gen->tap_count; i++)
        if (gen->taps[i].axes & s->uses) {
            s->reach = fmax(s->reach, -gen->taps[i].time);
            s->lag = fmax(s->lag, gen->taps[i].time);
            for (int j = AXIS_X; j <= AXIS_Z; j++)
                s->between &= gen->taps[i].amplitude[j] >= 0;
        }
    s->curve |= s->reach > 0 || s->lag > 0;
}

bool step_settled(const struct step_gen *gen) {
    for (const struct stepper *s = gen->steppers; s < gen->steppers + gen->stepper_count; s++)
        if (s->curve && s->time < gen->moves_end + s->lag - ROUNDING_S)
            return false;
    return true;
}
