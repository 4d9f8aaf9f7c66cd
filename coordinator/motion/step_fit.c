// SPDX-License-Identifier: Apache-2.0
#include "coordinator/motion/step_fit.h"

#include <math.h>
#include <string.h>

// Vectors of eight: one register with AVX2, two with the baseline of x86-64 and AArch64. The same arithmetic
// either way, so every machine makes the same segments.
#if defined(__x86_64__) && !defined(__clang__) && !defined(__SANITIZE_ADDRESS__) &&                          \
    !defined(__SANITIZE_THREAD__)
#define VECTOR __attribute__((target_clones("avx2", "default")))
#else
#define VECTOR
#endif

enum {
    WIDE = 8,
    GATES = 128, // looked at, at most
    FINE = 64,   // of them, over the expected steps
    COARSE = 12, // with less than these over the steps reached, look again
    TRIALS = 16,
};

typedef float vector __attribute__((vector_size(4 * WIDE)));
typedef int32_t selection __attribute__((vector_size(4 * WIDE)));

static const float FAR = 1e30F;

// Gates behind the start, every STRIDE steps, as lines see them that are measured from interval and add.
struct grid {
    vector least[GATES + 1], most[GATES + 1]; // add·stride/2 after so many gates, spread over eight lanes
    float half[GATES + WIDE], low[GATES + WIDE], high[GATES + WIDE];
    int32_t count, stride;
    double interval, add;
};

// ------------------------------------------------------------------------------------------------ vectors

#define EIGHT(f, k) f(k), f((k) - 1), f((k) - 2), f((k) - 3), f((k) - 4), f((k) - 5), f((k) - 6), f((k) - 7)
#define ALL(f)                                                                                               \
    EIGHT(f, 128), EIGHT(f, 120), EIGHT(f, 112), EIGHT(f, 104), EIGHT(f, 96), EIGHT(f, 88), EIGHT(f, 80),    \
        EIGHT(f, 72), EIGHT(f, 64), EIGHT(f, 56), EIGHT(f, 48), EIGHT(f, 40), EIGHT(f, 32), EIGHT(f, 24),    \
        EIGHT(f, 16), EIGHT(f, 8)
#define INVERSE_OF(k) 1.0F / (float)(k)
#define NOTHING(k) 0 * (k) - 1e30F
_Static_assert(GATES == 128, "the tables have as many entries");
// From [GATES − j] on: 1/j, 1/(j−1), … 1, then 0; and 0 for as many, then −huge.
static const float INVERSE[2 * GATES] = {ALL(INVERSE_OF)};
static const float BEHIND[2 * GATES] = {[GATES] = ALL(NOTHING)};

static inline void load(vector *v, const float *at) {
    memcpy(v, at, sizeof(*v));
}

static inline void raise(vector *most, const vector *v) {
    const selection keep = *most > *v;
    *most = (vector)(((selection)*most & keep) | ((selection)*v & ~keep));
}

static inline void lower(vector *least, const vector *v) {
    const selection keep = *least < *v;
    *least = (vector)(((selection)*least & keep) | ((selection)*v & ~keep));
}

static inline float largest(const vector *v) {
    vector a = *v, b = __builtin_shufflevector(a, a, 4, 5, 6, 7, 0, 1, 2, 3);
    raise(&a, &b);
    b = __builtin_shufflevector(a, a, 2, 3, 0, 1, 6, 7, 4, 5);
    raise(&a, &b);
    return a[0] > a[1] ? a[0] : a[1];
}

static inline float smallest(const vector *v) {
    const vector negative = -*v;
    return -largest(&negative);
}

// -------------------------------------------------------------------------------------------------- gates

static inline void put_gate(const struct fit_problem *p, struct grid *g, int32_t i, int32_t step) {
    const double n = step, inverse = 1 / n, bent = g->interval + g->add * (n - 1) * 0.5;
    g->half[i] = (float)((n - 1) * 0.5);
    g->low[i] = (float)((p->low[step - 1] - p->clock) * inverse - bent);
    g->high[i] = (float)((p->high[step - 1] - p->clock) * inverse - bent);
}

// Fills in gates up to TO, and as many more as vectors reach.
VECTOR static void put_gates(const struct fit_problem *p, struct grid *g, int32_t from, int32_t to) {
    if (g->stride == 1)
        for (int32_t i = from; i < to; i++)
            put_gate(p, g, i, i + 1);
    else
        for (int32_t i = from; i < to; i++)
            put_gate(p, g, i, (i + 1) * g->stride);
    for (int32_t i = to; i < from + WIDE; i++)
        g->half[i] = g->low[i] = g->high[i] = 0;
}

// Narrows the range of adds by the pairs of gate I, which is LOW to HIGH, with those before it.
static inline void pairs(const struct grid *g, int32_t i, float low, float high, vector *least,
                         vector *most) {
    const float *inverse = INVERSE + GATES - i, *behind = BEHIND + GATES - i;
    for (int32_t j = 0; j < i; j += WIDE) {
        vector k, none, a, b;
        load(&k, inverse + j);
        load(&none, behind + j);
        load(&a, g->high + j);
        load(&b, g->low + j);
        a = (low - a) * k + none;
        b = (high - b) * k - none;
        raise(least, &a);
        lower(most, &b);
    }
}

struct range {
    float least, most;
};

// The intervals with which ADD passes through the first I gates.
static inline struct range intervals(const struct grid *g, int32_t i, float add) {
    const float *behind = BEHIND + GATES - i;
    vector least = {0}, most = {0};
    least -= FAR, most += FAR;
    for (int32_t j = 0; j < i; j += WIDE) {
        vector half, none, a, b;
        load(&half, g->half + j);
        load(&none, behind + j);
        load(&a, g->low + j);
        load(&b, g->high + j);
        a = a - add * half + none;
        b = b - add * half - none;
        raise(&least, &a);
        lower(&most, &b);
    }
    return (struct range){largest(&least), smallest(&most)};
}

// --------------------------------------------------------------------------------------------------- ends

// Of the adds FIRST..LAST, measured from FROM, the one next to ADD that takes fewest bytes on the wire.
static inline float shorter(float add, float from, float first, float last) {
    static const float LEAST[] = {-32, -4096}, MOST[] = {95, 12287};
    for (int bytes = 0; bytes < 2; bytes++) {
        const float low = LEAST[bytes] - from, high = MOST[bytes] - from;
        const float near = add < low ? low : add > high ? high : add;
        if (near >= first && near <= last)
            return near;
    }
    return add;
}

// The segment through the first I gates whose last step comes between FROM and TO, as shares of its band.
VECTOR static bool end_between(const struct grid *g, int32_t i, float from, float to, struct fit_segment *s) {
    const float middle = 0.5F * (g->low[i - 1] + g->high[i - 1]),
                wide = 0.5F * (g->high[i - 1] - g->low[i - 1]);
    const float low = middle + from * wide, high = middle + to * wide, scale = 2.0F / (float)g->stride;
    vector least = g->least[i - 1], most = g->most[i - 1];
    pairs(g, i - 1, low, high, &least, &most);
    const float lowest = (float)(-FIT_ADD_MAX - 1 - g->add), highest = (float)(FIT_ADD_MAX - g->add);
    float first = ceilf(largest(&least) * scale), last = floorf(smallest(&most) * scale);
    first = first > lowest ? first : lowest;
    last = last < highest ? last : highest;
    const float middle_add = floorf(0.5F * (first + last)),
                short_add = shorter(middle_add, (float)g->add, first, last);
    const float adds[] = {short_add, middle_add, first, last};
    for (int j = 0; j < 4 && first <= last; j++) {
        struct range r = intervals(g, i - 1, adds[j]);
        const float bent = adds[j] * g->half[i - 1];
        r.least = ceilf(r.least > low - bent ? r.least : low - bent);
        r.most = floorf(r.most < high - bent ? r.most : high - bent);
        if (r.least <= r.most) {
            *s = (struct fit_segment){(uint32_t)(i * g->stride),
                                      g->interval + floorf(0.5F * (r.least + r.most)), g->add + adds[j]};
            return true;
        }
        if (first == last)
            break;
    }
    return false;
}

// Fills in gates until no line passes through them; returns how many a line does.
VECTOR static int32_t pass(const struct fit_problem *p, struct grid *g) {
    struct fit_segment s;
    vector least = {0}, most = {0};
    least -= FAR, most += FAR;
    g->least[0] = least, g->most[0] = most;
    for (int32_t i = 0; i < g->count;) {
        const int32_t stop = i + WIDE < g->count ? i + WIDE : g->count;
        put_gates(p, g, i, stop);
        for (; i < stop; i++) {
            pairs(g, i, g->low[i], g->high[i], &least, &most);
            g->least[i + 1] = least, g->most[i + 1] = most;
        }
        if (largest(&least) > smallest(&most)) {
            while (largest(&g->least[i]) > smallest(&g->most[i]))
                i--;
            return i;
        }
        // A line passes further than any in whole ticks; behind the steps expected that is worth finding out.
        if (i >= FINE && !end_between(g, i, -1, 1, &s))
            return i;
    }
    return g->count;
}

// From where lines are measured, so that single precision suffices: about the segment over N steps.
static void aim(const struct fit_problem *p, struct grid *g, uint32_t n) {
    const uint32_t half = n / 2;
    const double whole = (p->ticks[n - 1] - p->clock) / n;
    g->add = 0;
    if (half) {
        const double begin = (p->ticks[half - 1] - p->clock) / half;
        g->add = fmin(fmax(nearbyint((whole - begin) * 2 / (n - half)), -FIT_ADD_MAX), FIT_ADD_MAX);
    }
    g->interval = nearbyint(whole - g->add * (n - 1.0) * 0.5);
}

static uint32_t between(uint32_t value, uint32_t low, uint32_t high) {
    return value < low ? low : value > high ? high : value;
}

// Of the first I gates, how many a line in whole ticks passes: on a long cruise far fewer than a line does.
// Steps back by ever more, then halves.
static int32_t last_in_whole_ticks(const struct grid *g, int32_t i) {
    struct fit_segment s;
    int32_t beyond = i + 1;
    for (int32_t back = 1; i > 0 && !end_between(g, i, -1, 1, &s); back *= 2) {
        beyond = i;
        i = i > back ? i - back : 0;
    }
    while (beyond - i > 1) {
        const int32_t middle = (i + beyond) / 2;
        *(end_between(g, middle, -1, 1, &s) ? &i : &beyond) = middle;
    }
    return i;
}

// Lays out gates and finds how many of them a segment passes; coarser or finer ones when EXPECTED was wrong.
static int32_t lay_out(const struct fit_problem *p, struct grid *g, uint32_t count) {
    uint32_t expected = between(p->expected, 1, count);
    for (int trial = 0;; trial++) {
        aim(p, g, expected);
        g->stride = (int32_t)((expected + FINE - 1) / FINE);
        const uint32_t gates = count / (uint32_t)g->stride;
        g->count = (int32_t)(gates < GATES ? gates : GATES);
        const int32_t top = last_in_whole_ticks(g, pass(p, g));
        const uint32_t reached = (uint32_t)(top * g->stride);
        if (trial < TRIALS && top == g->count && reached + (uint32_t)g->stride <= count)
            expected = between(reached * 3 / 2, 1, count);
        else if (trial < TRIALS && g->stride > 1 && top < COARSE)
            expected = between(reached, 8, expected / 2);
        else
            return top;
    }
}

void step_fit(const struct fit_problem *p, struct fit *out) {
    static const float EDGES[FIT_ENDS + 1] = {-1, -1.0F / 3, 1.0F / 3, 1};
    struct grid g;
    *out = (struct fit){0};
    const uint32_t count = between(p->count, 0, FIT_COUNT_MAX);
    if (!count)
        return;
    const int32_t top = lay_out(p, &g, count);
    out->open = p->count <= FIT_COUNT_MAX && (uint32_t)((top + 1) * g.stride) > count;
    for (int end = 0; end < FIT_ENDS; end++)
        for (int32_t i = top; 2 * i > top; i -= 1 + (top - i) / 2)
            if (end_between(&g, i, EDGES[end], EDGES[end + 1], &out->end[end]))
                break;
    if (!top)
        out->end[1] = (struct fit_segment){1, 0, 0}; // for step_fit_check to complete
}

// ------------------------------------------------------------------------------------------------- checks

static inline bool fits(const struct fit_problem *p, const struct fit_segment *s, uint32_t i) {
    const double n = (double)(int32_t)i + 1, at = p->clock + s->interval * n + 0.5 * s->add * n * (n - 1);
    return (at >= p->low[i]) & (at <= p->high[i]);
}

// How many of the first COUNT steps are in their bands.
VECTOR static uint32_t count_good(const struct fit_problem *p, const struct fit_segment *s, uint32_t count) {
    enum { BLOCK = 16 };
    uint32_t i = 0;
    for (; i + BLOCK <= count; i += BLOCK) {
        int64_t bad = 0;
        for (uint32_t j = 0; j < BLOCK; j++)
            bad |= !fits(p, s, i + j);
        if (bad)
            break;
    }
    while (i < count && fits(p, s, i))
        i++;
    return i;
}

static bool single(const struct fit_problem *p, struct fit_segment *s) {
    const double first = fmax(ceil(p->low[0] - p->clock), p->shortest), last = floor(p->high[0] - p->clock);
    *s = (struct fit_segment){1, fmin(fmax(nearbyint(p->ticks[0] - p->clock), first), last), 0};
    return first <= last;
}

bool step_fit_check(const struct fit_problem *p, struct fit_segment *s) {
    if (s->interval < p->shortest)
        return single(p, s);
    uint32_t count = s->count;
    const uint32_t rest = p->count - count;
    if (rest && rest <= count / 8 + 1 && p->count <= FIT_COUNT_MAX && count_good(p, s, p->count) == p->count)
        count = p->count;
    else
        count = count_good(p, s, count);
    if (s->add < 0) { // the last interval is the shortest
        const double most = floor((s->interval - p->shortest) / -s->add) + 1;
        count = most < count ? (uint32_t)most : count;
    }
    if (!count)
        return single(p, s);
    s->count = count;
    return true;
}
