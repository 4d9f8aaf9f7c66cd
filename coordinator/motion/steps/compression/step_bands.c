// SPDX-License-Identifier: Apache-2.0
// Compiled twice on x86-64: see step_arithmetic.c.
#include "coordinator/motion/steps/compression/step_bands.h"
#include "coordinator/motion/steps/compression/step_lanes.h"

#include <math.h>

static inline void band(const struct step_bands *b, size_t i) {
    const double *t = b->ticks, before = t[i] - (i ? t[i - 1] : b->before),
                 behind = (i + 1 < b->count ? t[i + 1] : b->next) - t[i];
    const double half = 0.5 * (before < behind ? before : behind),
                 e = half < b->max_error ? half : b->max_error;
    b->low[i] = t[i] - e;
    b->high[i] = t[i] + e;
}

double VARIANT(step_bands)(const struct step_bands *b) {
    const double *t = b->ticks;
    const quad far = {HUGE_VAL, HUGE_VAL, HUGE_VAL, HUGE_VAL}, most = b->max_error - (quad){0};
    quad closest = far;
    band(b, 0);
    size_t i = 1;
    for (; i + QUAD < b->count; i += QUAD) {
        const quad at = load_quad(t + i), before = at - load_quad(t + i - 1),
                   behind = load_quad(t + i + 1) - at;
        const quad e = smaller_quad(0.5 * smaller_quad(before, behind), most), low = at - e, high = at + e;
        memcpy(b->low + i, &low, sizeof(low));
        memcpy(b->high + i, &high, sizeof(high));
        closest = smaller_quad(closest, before);
    }
    double least = fmin(fmin(closest[0], closest[1]), fmin(closest[2], closest[3]));
    for (; i < b->count; i++) {
        band(b, i);
        least = fmin(least, t[i] - t[i - 1]);
    }
    return least;
}

// A few steps at once. Clocks are whole numbers below 2^53: the sums are exact.
bool VARIANT(step_replay)(const struct replay *r, double *worst) {
    static const quad FIRST = {1, 2, 3, 4};
    const double interval = r->interval, add = r->add, bend = QUAD * QUAD * add;
    quad at = (double)r->clock + interval * FIRST + add * (0.5 * FIRST * (FIRST - 1));
    quad ahead = QUAD * interval + add * (QUAD * FIRST + 6), most = {0}, beyond = {0};
    size_t i = 0;
    for (; i + QUAD <= r->count; i += QUAD) {
        const quad error = at - load_quad(r->ticks + i);
        most = larger_quad(most, larger_quad(error, -error));
        beyond = larger_quad(beyond, larger_quad(load_quad(r->low + i) - at, at - load_quad(r->high + i)));
        at += ahead;
        ahead += bend;
    }
    *worst = fmax(fmax(most[0], most[1]), fmax(most[2], most[3]));
    bool good = !any_above_0(beyond);
    for (int lane = 0; i < r->count; i++, lane++) {
        good &= (at[lane] >= r->low[i]) & (at[lane] <= r->high[i]);
        *worst = fmax(*worst, fabs(at[lane] - r->ticks[i]));
    }
    const int64_t n = r->count, bent = r->add, first = r->interval;
    return good && first >= r->shortest && first + bent * (n - 1) >= r->shortest &&
           r->clock + first * n + bent * n * (n - 1) / 2 == r->finish;
}
