// SPDX-License-Identifier: Apache-2.0
// Lines through the gates of step_fit.h: a part of step_fit.c, compiled with it for each processor.
#ifndef MOTION_STEP_GATES_H
#define MOTION_STEP_GATES_H

#include "coordinator/motion/steps/compression/step_fit.h"
#include "coordinator/motion/steps/compression/step_lanes.h"

enum {
    GATES = FIT_GATES,
    SPREAD = 12, // gates over the expected steps
    PLACES = 48, // where a segment may end, over the expected steps
    TOO_FEW = 7, // gates passed: what was expected is so wrong that it is better to look again
    TRIALS = 12, // to get that right
    REACH = 128, // of the tables, in places
};
_Static_assert(GATES *(PLACES + SPREAD / 2) / SPREAD + WIDE < 120, "the tables cover all places");

static const float FAR = 1e30F;

// ------------------------------------------------------------------------------------------------- tables

#define EIGHT(f, k) f(k), f((k) + 1), f((k) + 2), f((k) + 3), f((k) + 4), f((k) + 5), f((k) + 6), f((k) + 7)
#define FORTY(f, k) EIGHT(f, k), EIGHT(f, (k) + 8), EIGHT(f, (k) + 16), EIGHT(f, (k) + 24), EIGHT(f, (k) + 32)
#define INVERSE_OF(k) (1.0F / (float)(k))
#define NOTHING(k) (0 * (k) - 1e36F)
// [REACH + k]: 1/k, and what takes a place that is not behind (k < 1) out of a comparison.
static const float INVERSE[2 * REACH] = {
    [REACH + 1] = FORTY(INVERSE_OF, 1), FORTY(INVERSE_OF, 41), FORTY(INVERSE_OF, 81)};
static const float NONE[2 * REACH] = {FORTY(NOTHING, 0), FORTY(NOTHING, 0), FORTY(NOTHING, 0),
                                      EIGHT(NOTHING, 0), NOTHING(0)};
// [GATES − n + i]: takes gates i ≥ n out.
static const float BEYOND[2 * GATES + FIT_LANES] = {
    [GATES] = EIGHT(NOTHING, 0), EIGHT(NOTHING, 0), EIGHT(NOTHING, 0), EIGHT(NOTHING, 0)};

// -------------------------------------------------------------------------------------------------- gates

struct gates {
    vector low, high;
};

struct half_gates {
    four low, high;
};

// The gates of QUAD steps whose numbers are N and whose bands are LOW to HIGH.
static inline struct half_gates gates_of(const struct fit_problem *p, const struct fit *f, quad n, quad low,
                                         quad high) {
    const quad base = p->clock + n * (f->interval + f->add * 0.5 * (n - 1));
    const four inverse = 1 / __builtin_convertvector(n, four);
    return (struct half_gates){__builtin_convertvector(low - base, four) * inverse,
                               __builtin_convertvector(high - base, four) * inverse};
}

// QUAD gates, at every APART-th step from FIRST on; instead of those behind LAST, LAST once more.
static inline struct half_gates half_gates_from(const struct fit_problem *p, const struct fit *f,
                                                int32_t first, int32_t apart, int32_t last) {
    const double *l = p->low - 1, *h = p->high - 1;
    int32_t a = first, b = a + apart, c = b + apart, d = c + apart;
    if (d > last) {
        a = a < last ? a : last, b = b < last ? b : last, c = c < last ? c : last, d = last;
    } else if (apart == 1) {
        static const quad ZERO_ON = {0, 1, 2, 3};
        return gates_of(p, f, first + ZERO_ON, load_quad(l + first), load_quad(h + first));
    }
    return gates_of(p, f, (quad){a, b, c, d}, (quad){l[a], l[b], l[c], l[d]}, (quad){h[a], h[b], h[c], h[d]});
}

static inline struct gates gates_from(const struct fit_problem *p, const struct fit *f, int32_t first,
                                      int32_t apart, int32_t last) {
    const struct half_gates a = half_gates_from(p, f, first, apart, last);
#if defined __AVX2__
    const struct half_gates b = half_gates_from(p, f, first + QUAD * apart, apart, last);
    return (struct gates){__builtin_shufflevector(a.low, b.low, 0, 1, 2, 3, 4, 5, 6, 7),
                          __builtin_shufflevector(a.high, b.high, 0, 1, 2, 3, 4, 5, 6, 7)};
#else
    return (struct gates){a.low, a.high};
#endif
}

// Puts WIDE gates from place BEGIN on, and narrows the slopes by their pairs with those before and with each
// other. Returns through how many of them lines pass.
static inline int32_t put_gates(struct fit *f, int32_t begin, struct gates g) {
    vector least = all(-FAR), most = all(FAR);
    store(f->low + begin, &g.low), store(f->high + begin, &g.high);
    int32_t i = 0;
    for (; i < begin; i++) {
        const vector k = load(INVERSE + REACH + begin - i);
        least = larger(least, (g.low - f->high[i]) * k);
        most = smaller(most, (g.high - f->low[i]) * k);
    }
    for (; i < begin + WIDE - 1; i++) {
        const vector k = load(INVERSE + REACH + begin - i), none = load(NONE + REACH + begin - i);
        least = larger(least, (g.low - f->high[i]) * k + none);
        most = smaller(most, (g.high - f->low[i]) * k - none);
    }
    const float inverse = INVERSE[REACH + f->spacing];
    least = larger(largest_so_far(least * inverse), all(f->least[begin]));
    most = smaller(-largest_so_far(-most * inverse), all(f->most[begin]));
    store(f->least + begin + 1, &least), store(f->most + begin + 1, &most);
    return __builtin_ctz(~(unsigned)not_above(least, most));
}

// Puts up to COUNT gates until no line passes; returns how many one does.
static inline int32_t pass(const struct fit_problem *p, struct fit *f, int32_t count) {
    const int32_t apart = f->stride * f->spacing;
    f->least[0] = -FAR, f->most[0] = FAR;
    for (int32_t i = 0; i < count; i += WIDE) {
        const struct gates gates = gates_from(p, f, (i + 1) * apart, apart, count * apart);
        const int32_t passed = put_gates(f, i, gates);
        if (passed < WIDE)
            return i + passed < count ? i + passed : count;
    }
    return count;
}

// -------------------------------------------------------------------------------------------------- lines

// Gates before place AT. (The product is never near a whole number.)
static inline int32_t gates_before(const struct fit *f, int32_t at) {
    return (int32_t)(((float)at - 0.5F) * INVERSE[REACH + f->spacing]);
}

// Slopes from a last step between LOW and HIGH at place AT through all gates before it.
static inline struct range slopes(const struct fit *f, int32_t at, int32_t before, float low, float high) {
    vector least = all(f->least[before]), most = all(f->most[before]);
    for (int32_t i = 0; i < before; i += WIDE) {
        const vector none = load(BEYOND + GATES - before + i);
        const vector k = 1.0F / ((float)at - (COUNTING + (float)i) * (float)f->spacing);
        least = larger(least, (low - load(f->high + i)) * k + none);
        most = smaller(most, (high - load(f->low + i)) * k - none);
    }
    return narrowest(least, most);
}

// Where lines with this ADD may begin to pass through all gates before.
static inline struct range begins(const struct fit *f, int32_t before, float add) {
    const float apart = 0.5F * (float)(f->stride * f->spacing);
    vector least = all(-FAR), most = all(FAR);
    for (int32_t i = 0; i < before; i += WIDE) {
        const vector none = load(BEYOND + GATES - before + i);
        const vector bent = add * ((COUNTING + (float)i) * apart - 0.5F);
        least = larger(least, load(f->low + i) - bent + none);
        most = smaller(most, load(f->high + i) - bent - none);
    }
    return narrowest(least, most);
}

static inline void narrow(struct range *r, float least, float most) {
    r->least = least > r->least ? least : r->least;
    r->most = most < r->most ? most : r->most;
}

// The same with the extra gates.
static void slopes_of_extra(const struct fit *f, int32_t at, int32_t before, float low, float high,
                            struct range *r) {
    for (int32_t e = 0; e < f->extra; e++) {
        const float place = f->extra_place[e], a = f->extra_low[e], b = f->extra_high[e];
        if (place >= (float)at)
            continue;
        narrow(r, (low - b) / ((float)at - place), (high - a) / ((float)at - place));
        for (int32_t i = 0; i < before; i++) {
            const float away = place - (float)((i + 1) * f->spacing);
            if (away > 0)
                narrow(r, (a - f->high[i]) / away, (b - f->low[i]) / away);
            else if (away < 0)
                narrow(r, (b - f->low[i]) / away, (a - f->high[i]) / away);
        }
    }
}

static void begins_of_extra(const struct fit *f, int32_t at, float add, struct range *r) {
    for (int32_t e = 0; e < f->extra; e++) {
        const float bent = add * 0.5F * (f->extra_place[e] * (float)f->stride - 1);
        if (f->extra_place[e] < (float)at)
            narrow(r, f->extra_low[e] - bent, f->extra_high[e] - bent);
    }
}

#endif
