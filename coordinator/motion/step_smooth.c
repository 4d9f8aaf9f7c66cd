// SPDX-License-Identifier: Apache-2.0
// Pressure advance, smoothed: E_s(t) = ∫ w(τ)·p(t + τ) dτ with p = E + pa·E' and the triangle
// w(τ) = (h − |τ|)/h². Then E_s' = (∫ p right of t − ∫ p left of t)/h² and E_s'' = (p(t−h) − 2·p(t) +
// p(t+h))/h², which is quadratic between the borders of phases and these borders ± h: there E_s is quartic.
#include "coordinator/motion/step_internal.h"

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
        const double pa = m.pressure_advance, v = m.v[AXIS_E], a = m.a[AXIS_E];
        const double c0 = m.p[AXIS_E] + pa * v - reference, c1 = v + pa * a, c2 = a / 2;
        const double sum = x * (c0 + x * (c1 / 2 + x * c2 / 3));
        const double first = x * x * (c0 / 2 + x * (c1 / 3 + x * c2 / 4));
        half.sum += sum;
        half.moment += fabs(at - outer) * sum + (outer < to ? first : -first);
        at = end;
    }
    return half;
}

double step_smooth(const struct step_gen *gen, struct stepper *s, double time, double poly[5]) {
    const double h = s->smooth_s / 2, factor[3] = {1, -2, 1};
    struct motion m[3];
    double border = HUGE_VAL, d[3] = {0, 0, 0};
    for (int i = 0; i < 3; i++) {
        const double shift = (i - 1) * h;
        step_locate(gen, &s->cursor[STEP_TAPS + i], time + shift, &m[i]);
        border = fmin(border, m[i].border - shift);
    }
    const double reference = m[1].p[AXIS_E];
    for (int i = 0; i < 3; i++) {
        const double pa = m[i].pressure_advance, v = m[i].v[AXIS_E], a = m[i].a[AXIS_E];
        d[0] += factor[i] * (m[i].p[AXIS_E] - reference + pa * v);
        d[1] += factor[i] * (v + pa * a);
        d[2] += factor[i] * a / 2;
    }
    const struct half left = integrate(gen, s->cursor[STEP_TAPS], time - h, time, time - h, reference);
    const struct half right = integrate(gen, s->cursor[STEP_TAPS + 1], time, time + h, time + h, reference);
    const double scale = 1 / (h * h);
    poly[0] = reference + (left.moment + right.moment) * scale;
    poly[1] = (right.sum - left.sum) * scale;
    poly[2] = d[0] * scale / 2;
    poly[3] = d[1] * scale / 6;
    poly[4] = d[2] * scale / 12;
    return border;
}
