// SPDX-License-Identifier: Apache-2.0
// sources: coordinator/motion/steps/compression/step_arithmetic.c
// sources: coordinator/motion/steps/compression/step_fit.c
// sources: coordinator/motion/steps/compression/step_bands.c
// The fit against trying every add and interval, and the processor's
// own arithmetic against the baseline.
#include "coordinator/motion/steps/compression/step_arithmetic.h"
#include "tests/check.h"

#include <math.h>
#include <string.h>

enum { STEPS = 200, PROBLEMS = 120 };

static uint64_t state = 1;

static double chance(double low, double high) {
    state ^= state << 13, state ^= state >> 7, state ^= state << 17;
    return low + (high - low) * (double)(state >> 11) / 9007199254740992.0;
}

static double ticks[STEPS], low[STEPS], high[STEPS];

// Steps of a ramp, then of a cruise, at 16 to 168 ticks a microsecond.
static struct fit_problem make_problem(void) {
    const double per_us = chance(16, 168), v0 = chance(0.0005, 0.02), a = chance(-1e-8, 4e-7),
                 ramp = chance(5, 80);
    const double clock = floor(chance(-3 * per_us, 3 * per_us));
    double t = 0;
    for (int i = 0; i < STEPS; i++) {
        const double n = i + 1 < ramp ? i + 1 : ramp, v = sqrt(fmax(v0 * v0 + 2 * a * n, v0 * v0 / 4));
        t += per_us / v;
        ticks[i] = t;
    }
    const struct step_bands bands = {ticks, STEPS, -per_us / v0, t + per_us / v0, 12.5 * per_us, low, high};
    step_bands(&bands);
    const uint32_t most = chance(0, 1) < 0.5 ? FIT_COUNT_MAX : (uint32_t)chance(1, 100);
    return (struct fit_problem){ticks, low, high, STEPS, most, (uint32_t)chance(1, 100), clock, 2};
}

// The most steps that ADD reaches, whatever the interval.
static uint32_t reach(const struct fit_problem *p, double add) {
    double least = p->shortest, most = 4294967295.0;
    const uint32_t count = p->count < p->most ? p->count : p->most;
    for (uint32_t i = 0; i < count; i++) {
        const double n = i + 1.0, bent = add * n * (n - 1) / 2;
        least = fmax(least, ceil((p->low[i] - p->clock - bent) / n));
        most = fmin(most, floor((p->high[i] - p->clock - bent) / n));
        if (least > most || least + add * i < p->shortest)
            return i;
    }
    return count;
}

static uint32_t longest(const struct fit_problem *p) {
    uint32_t best = 0;
    for (int add = -FIT_ADD_MAX - 1; add <= FIT_ADD_MAX; add++) {
        const uint32_t count = reach(p, add);
        best = count > best ? count : best;
    }
    return best;
}

static bool is_right(const struct fit_problem *p, const struct fit_segment *s) {
    const int64_t shortest = (int64_t)p->shortest; // whole: the problems' makers see to that
    int64_t clock = (int64_t)p->clock, interval = (int64_t)s->interval;
    for (uint32_t i = 0; i < s->count; i++) {
        clock += interval;
        if (interval < shortest || (double)clock < p->low[i] || (double)clock > p->high[i])
            return false;
        interval += (int64_t)s->add;
    }
    return true;
}

static void test_segments_are_right_and_as_long_as_can_be(void) {
    uint32_t made = 0, possible = 0;
    for (int i = 0; i < PROBLEMS; i++) {
        const struct fit_problem p = make_problem();
        struct fit f;
        step_fit_find(&p, &f);
        uint32_t best = 0;
        for (int end = 0; end < FIT_ENDS; end++) {
            struct fit_segment s;
            if (!f.count[end] || !step_fit_make(&p, &f, end, &s))
                continue;
            CHECK(s.count > 0 && is_right(&p, &s));
            best = s.count > best ? s.count : best;
        }
        const uint32_t most = longest(&p);
        CHECK(best <= most);
        made += best, possible += most;
        CHECK(best + 2 + best / 48 >= most); // ends are looked for at 48 places, or every step
    }
    CHECK(made > 0.995 * possible);
}

static void test_arithmetic_is_the_same_everywhere(void) {
    const struct step_arithmetic *here = step_arithmetic();
    for (int i = 0; i < 50 * PROBLEMS; i++) {
        const struct fit_problem p = make_problem();
        struct fit a, b;
        step_fit_find(&p, &a), here->fit_find(&p, &b);
        CHECK(a.open == b.open && !memcmp(a.count, b.count, sizeof(a.count)));
        for (int end = 0; end < FIT_ENDS; end++) {
            struct fit_segment s = {0}, t = {0};
            if (!a.count[end])
                continue;
            CHECK(step_fit_make(&p, &a, end, &s) == here->fit_make(&p, &b, end, &t));
            CHECK(s.count == t.count && s.interval == t.interval && s.add == t.add);
        }
        double other_low[STEPS], other_high[STEPS];
        const struct step_bands bands = {ticks, STEPS, 0, ticks[STEPS - 1] * 2, 900, low, high},
                                others = {ticks, STEPS, 0, ticks[STEPS - 1] * 2, 900, other_low, other_high};
        CHECK(step_bands(&bands) == here->bands(&others));
        CHECK(!memcmp(low, other_low, sizeof(low)) && !memcmp(high, other_high, sizeof(high)));
    }
}

int main(void) {
    test_segments_are_right_and_as_long_as_can_be();
    test_arithmetic_is_the_same_everywhere();
    return 0;
}
