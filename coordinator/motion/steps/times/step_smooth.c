// SPDX-License-Identifier: Apache-2.0
// Pressure advance, smoothed: E_s(t) = ∫ w(τ)·p(t + τ) dτ with p = E + pa·E' and the triangle
// w(τ) = (h − |τ|)/h². Then E_s' = (∫ p right of t − ∫ p left of t)/h² and E_s'' = (p(t−h) − 2·p(t) +
// p(t+h))/h², which is quadratic between the borders of phases and these borders ± h: there E_s is quartic.
#include "coordinator/motion/steps/step_internal.h"

enum { TRUSTED = 64 };

// ∫ p and ∫ |distance from FROM's outer end|·p over one half of the window.
struct half {
    double sum, moment;
};

// OUTER: the end of the window that this half touches. REFERENCE is subtracted from p, against cancellation.
static struct half integrate(const struct step_gen *gen, uint64_t cursor, double from, double to,
                             double outer, double reference) {
    struct half half = {0, 0};
    for (double at = from; at < to - ROUNDING_S / 2;) {
        struct motion m;
        step_locate(gen, &cursor, at, &m);
        const double end = fmax(fmin(m.border, to), at + ROUNDING_S / 2), x = fmin(end, to) - at;
        const double pa = m.pressure_advance, v = speed_of(&m, AXIS_E), a = accel_of(&m, AXIS_E);
        const double c0 = place_of(&m, AXIS_E) + pa * v - reference, c1 = v + pa * a, c2 = a / 2;
        const double sum = x * (c0 + x * (c1 / 2 + x * c2 / 3));
        const double first = x * x * (c0 / 2 + x * (c1 / 3 + x * c2 / 4));
        half.sum += sum;
        half.moment += fabs(at - outer) * sum + (outer < to ? first : -first);
        at = end;
    }
    return half;
}

// p around TIME + SHIFT, as powers of the time since the piece's begin TIME.
static void look(const struct step_gen *gen, struct stepper *s, int which, double time, double shift,
                 double poly[3]) {
    struct seen *seen = &s->seen[STEP_TAPS + which];
    if (seen->border == -HUGE_VAL || is_over(seen->border, time)) {
        struct motion m;
        step_locate(gen, &s->cursor[STEP_TAPS + which], time + shift, &m);
        const double pa = m.pressure_advance, v = speed_of(&m, AXIS_E), a = accel_of(&m, AXIS_E);
        *seen = (struct seen){.time = time,
                              .border = m.border - shift,
                              .poly = {place_of(&m, AXIS_E) + pa * v, v + pa * a, a / 2}};
    }
    const double t = time - seen->time;
    poly[0] = seen->poly[0] + t * (seen->poly[1] + t * seen->poly[2]);
    poly[1] = seen->poly[1] + 2 * t * seen->poly[2];
    poly[2] = seen->poly[2];
}

// Place and speed from the window's integrals.
static void integrate_all(const struct step_gen *gen, const struct stepper *s, double time, double reference,
                          double poly[2]) {
    const double h = s->smooth_s / 2, scale = 1 / (h * h);
    const struct half left = integrate(gen, s->cursor[STEP_TAPS], time - h, time, time - h, reference);
    const struct half right = integrate(gen, s->cursor[STEP_TAPS + 1], time, time + h, time + h, reference);
    poly[0] = reference + (left.moment + right.moment) * scale;
    poly[1] = (right.sum - left.sum) * scale;
}

// E_s and E_s' are continuous: pieces go on where the last one ended, TRUSTED of them, then from the
// integrals.
double step_smooth(const struct step_gen *gen, struct stepper *s, double time, double poly[5]) {
    const double h = s->smooth_s / 2, scale = 1 / (h * h);
    struct seen *seen = &s->seen[STEP_TAPS];
    double p[3][3], border = HUGE_VAL;
    for (int i = 0; i < 3; i++) {
        look(gen, s, i, time, (i - 1) * h, p[i]);
        border = fmin(border, seen[i].border);
    }
    if (!is_over(seen[0].border, time + 2 * h)) { // one phase from end to end
        poly[0] = p[1][0] + p[1][2] * h * h / 6;
        poly[1] = p[1][1];
        poly[2] = p[1][2];
        poly[3] = poly[4] = 0;
    } else {
        const double *c = s->smoothed, t = time - s->smoothed_time;
        if (s->trusted-- > 0) {
            poly[0] = c[0] + t * (c[1] + t * (c[2] + t * (c[3] + t * c[4])));
            poly[1] = c[1] + t * (2 * c[2] + t * (3 * c[3] + t * 4 * c[4]));
        } else {
            integrate_all(gen, s, time, p[1][0], poly);
            s->trusted = TRUSTED;
        }
        poly[2] = (p[0][0] - 2 * p[1][0] + p[2][0]) * scale / 2;
        poly[3] = (p[0][1] - 2 * p[1][1] + p[2][1]) * scale / 6;
        poly[4] = (p[0][2] - 2 * p[1][2] + p[2][2]) * scale / 12;
    }
    for (int k = 0; k < 5; k++)
        s->smoothed[k] = poly[k];
    s->smoothed_time = time;
    for (int i = 0; i < 3; i++)
        if (seen[i].border == HUGE_VAL)
            seen[i].border = -HUGE_VAL; // a move may be appended at any time
    return border;
}
