// SPDX-License-Identifier: Apache-2.0
// Compiled twice on x86-64: see step_arithmetic.c.
#include "coordinator/motion/steps/compression/step_fit.h"
#include "coordinator/motion/steps/compression/step_gates.h"

#include <math.h>

static const float EDGES[FIT_ENDS + 1] = {-1, -1.0F / 3, 1.0F / 3, 1};

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

// Whole adds, measured from F's, of lines to place AT whose last step comes between LOW and HIGH.
static struct fit_adds adds_to(const struct fit *f, int32_t at, int32_t before, float low, float high) {
    const float scale = 2.0F / (float)f->stride;
    struct range r = slopes(f, at, before, low, high);
    if (f->extra)
        slopes_of_extra(f, at, before, low, high, &r);
    return (struct fit_adds){ceilf(r.least * scale), floorf(r.most * scale)};
}

// The segment in whole ticks to place AT whose last step comes between FROM and TO, as shares of its band.
// KNOWN are the adds to there, if they are.
static inline bool end_between(const struct fit_problem *p, const struct fit *f, int32_t at, float from,
                               float to, const struct fit_adds *known, struct fit_segment *s) {
    const int32_t before = gates_before(f, at), steps = at * f->stride;
    const double n = steps, base = p->clock + n * (f->interval + f->add * 0.5 * (n - 1));
    const float inverse = 1.0F / (float)steps, below = (float)(p->low[steps - 1] - base) * inverse,
                above = (float)(p->high[steps - 1] - base) * inverse;
    const float middle = 0.5F * (below + above), wide = 0.5F * (above - below);
    const float low = middle + from * wide, high = middle + to * wide;
    const struct fit_adds to_there = known ? *known : adds_to(f, at, before, low, high);
    float first = -FIT_ADD_MAX - 1 - (float)f->add, last = FIT_ADD_MAX - (float)f->add;
    first = to_there.least > first ? to_there.least : first;
    last = to_there.most < last ? to_there.most : last;
    if (first > last)
        return false;
    const float middle_add = floorf(0.5F * (first + last)),
                adds[] = {shorter(middle_add, (float)f->add, first, last), middle_add, first, last};
    for (int j = 0; j < 4; j++) {
        const float bent = adds[j] * 0.5F * (float)(steps - 1);
        struct range r = begins(f, before, adds[j]);
        if (f->extra)
            begins_of_extra(f, at, adds[j], &r);
        narrow(&r, low - bent, high - bent);
        r = (struct range){ceilf(r.least), floorf(r.most)};
        if (r.least <= r.most) {
            // Nearer to the edge that is meant, but not at it: there the next segment has the whole band.
            const float share = 0.5F + 0.25F * (from + to);
            *s = (struct fit_segment){(uint32_t)steps,
                                      f->interval + floorf(r.least + share * (r.most - r.least)),
                                      f->add + adds[j]};
            return true;
        }
        if (first == last)
            break;
    }
    return false;
}

// Of the places up to AT, the last one with a segment in whole ticks: on a long cruise lines reach much
// further. Steps back by ever more, then halves. Returns 0, or the place and its segment.
static int32_t last_between(const struct fit_problem *p, const struct fit *f, int32_t at, float from,
                            float to, const struct fit_adds *known, struct fit_segment *s) {
    int32_t beyond = at + 1;
    for (int32_t back = 1; at > 0 && !end_between(p, f, at, from, to, known, s); back *= 2) {
        beyond = at;
        at = at > back ? at - back : 0;
        known = NULL;
    }
    while (beyond - at > 1) {
        const int32_t middle = (at + beyond) / 2;
        *(end_between(p, f, middle, from, to, NULL, s) ? &at : &beyond) = middle;
    }
    return at;
}

enum { SEEN = 8 }; // last places that are looked at
_Static_assert(SEEN % WIDE == 0, "whole vectors");

// Adds with which lines lead to each of SEEN places with each end, through all gates before it.
struct ends {
    float least[FIT_ENDS][SEEN], most[FIT_ENDS][SEEN]; // none where least > most
    unsigned passes[FIT_ENDS], whole[FIT_ENDS];        // places with lines, with lines of a whole add
};

// Looks at WIDE places from FIRST on, of those up to LAST; they are the ones of E from PART on.
static inline void look_at_ends(const struct fit_problem *p, const struct fit *f, int32_t gates,
                                int32_t first, int32_t last, struct ends *e, int part) {
    const struct gates ends = gates_from(p, f, first * f->stride, f->stride, last * f->stride);
    const int32_t before = gates_before(f, first);
    const vector third = (ends.high - ends.low) * (1.0F / 3);
    const vector edges[FIT_ENDS + 1] = {ends.low, ends.low + third, ends.high - third, ends.high};
    vector least[FIT_ENDS], most[FIT_ENDS];
    for (int end = 0; end < FIT_ENDS; end++)
        least[end] = all(f->least[before]), most[end] = all(f->most[before]);
    int32_t behind = first - f->spacing, i = 0;
    for (; i < before; i++, behind -= f->spacing) {
        const vector k = load(INVERSE + REACH + behind);
        for (int end = 0; end < FIT_ENDS; end++) {
            least[end] = larger(least[end], (edges[end] - f->high[i]) * k);
            most[end] = smaller(most[end], (edges[end + 1] - f->low[i]) * k);
        }
    }
    for (; i < gates && behind > -WIDE; i++, behind -= f->spacing) { // before some of them only
        const vector k = load(INVERSE + REACH + behind), none = load(NONE + REACH + behind);
        const vector through = f->least[i + 1] + none, under = f->most[i + 1] - none;
        for (int end = 0; end < FIT_ENDS; end++) {
            least[end] = larger(larger(least[end], through), (edges[end] - f->high[i]) * k + none);
            most[end] = smaller(smaller(most[end], under), (edges[end + 1] - f->low[i]) * k - none);
        }
    }
    const float scale = 2.0F / (float)f->stride;
    for (int end = 0; end < FIT_ENDS; end++) {
        e->passes[end] |= (unsigned)not_above(least[end], most[end]) << part;
        least[end] = -floors(-least[end] * scale), most[end] = floors(most[end] * scale);
        e->whole[end] |= (unsigned)not_above(least[end], most[end]) << part;
        store(e->least[end] + part, &least[end]), store(e->most[end] + part, &most[end]);
    }
}

// Finds the last place with each end, of the SEEN up to LAST.
static void find_ends(const struct fit_problem *p, struct fit *f, int32_t gates, int32_t last) {
    const int32_t first = last > SEEN ? last - SEEN + 1 : 1;
    const unsigned seen = (2U << (last - first)) - 1;
    struct ends e = {.passes = {0}};
    for (int part = 0; part < SEEN && first + part <= last; part += WIDE)
        look_at_ends(p, f, gates, first + part, last, &e, part);
    // On a long cruise whole adds may be further apart than lines: then only the making tells.
    const bool any = (e.whole[0] | e.whole[1] | e.whole[2]) & seen;
    for (int end = 0; end < FIT_ENDS; end++) {
        const unsigned found = (any ? e.whole[end] : e.passes[end]) & seen;
        if (!found)
            continue;
        const int place = 31 - __builtin_clz(found);
        f->count[end] = (uint32_t)((first + place) * f->stride);
        f->adds[end] = (struct fit_adds){e.least[end][place], e.most[end][place]};
    }
}

// ------------------------------------------------------------------------------------------------- layout

// From where lines are measured, so that single precision suffices: about the segment over N steps.
static inline void aim(const struct fit_problem *p, struct fit *f, uint32_t n) {
    const uint32_t half = n / 2;
    const double whole = (p->ticks[n - 1] - p->clock) * (1.0F / (float)n);
    double add = 0;
    if (half) {
        const double begin = (p->ticks[half - 1] - p->clock) * (1.0F / (float)half);
        add = rint((whole - begin) * (2.0F / (float)(n - half)));
        add = add < -FIT_ADD_MAX ? -FIT_ADD_MAX : add > FIT_ADD_MAX ? FIT_ADD_MAX : add;
    }
    f->add = add;
    f->interval = rint(whole - add * (n - 1.0) * 0.5);
}

static inline uint32_t between(uint32_t value, uint32_t low, uint32_t high) {
    return value < low ? low : value > high ? high : value;
}

// Lays out gates and finds how many of them lines pass; again when it was not about as many as expected.
static int32_t lay_out(const struct fit_problem *p, struct fit *f, uint32_t count) {
    uint32_t expected = between(p->expected, 1, count);
    for (int trial = 0;; trial++) {
        aim(p, f, expected);
        f->stride = (int32_t)((expected + PLACES - 1) / PLACES);
        const int32_t places = f->stride == 1 ? (int32_t)expected : (int32_t)expected / f->stride;
        f->spacing = places < SPREAD ? 1 : (places + SPREAD / 2) / SPREAD;
        const int32_t apart = f->stride * f->spacing,
                      room = count >= (uint32_t)(GATES * apart) ? GATES + 1 : (int32_t)count / apart;
        const int32_t gates = pass(p, f, room < GATES ? room : GATES);
        const uint32_t reached = (uint32_t)(gates * apart);
        if (trial < TRIALS && gates == GATES && room > GATES)
            expected = between(reached * 3 / 2, 1, count);
        else if (trial < TRIALS && apart > 1 && gates < TOO_FEW && reached < expected / 2)
            expected = between(reached + reached / 8, 1, expected / 2);
        else
            return gates;
    }
}

void VARIANT(step_fit_find)(const struct fit_problem *p, struct fit *f) {
    struct fit_segment s;
    memset(f->count, 0, sizeof(f->count));
    f->open = false;
    f->extra = 0;
    const uint32_t count = between(p->count, 0, p->most);
    if (!count)
        return;
    const int32_t gates = lay_out(p, f, count),
                  places = f->stride == 1 ? (int32_t)count : (int32_t)count / f->stride;
    int32_t last = (gates + 1) * f->spacing - 1;
    last = last < places ? last : places;
    // With an interval a tick longer the last step comes so many ticks later.
    const int32_t ticks = last * f->stride;
    if (last && ticks > p->high[ticks - 1] - p->low[ticks - 1])
        last = last_between(p, f, last, -1, 1, NULL, &s);
    f->open = p->count <= p->most && (uint32_t)((last + 1) * f->stride) > count;
    if (last)
        find_ends(p, f, gates, last);
    if (!f->count[0] && !f->count[1] && !f->count[2])
        f->count[1] = 1;
}

// ------------------------------------------------------------------------------------------------- checks

static inline double beyond_band(const struct fit_problem *p, const struct fit_segment *s, uint32_t i) {
    const double n = (double)(int32_t)i + 1, at = p->clock + s->interval * n + 0.5 * s->add * n * (n - 1);
    const double late = at - p->high[i], early = p->low[i] - at;
    return late > early ? late : early;
}

// How many of the first COUNT steps are in their bands. Whole numbers below 2^53: the sums are exact.
static uint32_t count_good(const struct fit_problem *p, const struct fit_segment *s, uint32_t count) {
    static const quad FIRST = {1, 2, 3, 4};
    quad at = p->clock + s->interval * FIRST + s->add * (0.5 * FIRST * (FIRST - 1));
    quad ahead = QUAD * s->interval + s->add * (QUAD * FIRST + 6);
    const double bend = QUAD * QUAD * s->add;
    uint32_t i = 0;
    for (; i + 2 * QUAD <= count; i += 2 * QUAD) {
        quad beyond = larger_quad(load_quad(p->low + i) - at, at - load_quad(p->high + i));
        at += ahead;
        ahead += bend;
        beyond = larger_quad(beyond, load_quad(p->low + i + QUAD) - at);
        beyond = larger_quad(beyond, at - load_quad(p->high + i + QUAD));
        at += ahead;
        ahead += bend;
        if (any_above_0(beyond)) {
            at -= 2 * ahead - 3 * bend;
            ahead -= 2 * bend;
            break;
        }
    }
    for (; i < count; i += QUAD, at += ahead, ahead += bend)
        for (uint32_t j = 0; j < QUAD; j++)
            if (i + j == count || at[j] < p->low[i + j] || at[j] > p->high[i + j])
                return i + j;
    return i;
}

static bool single(const struct fit_problem *p, int end, struct fit_segment *s) {
    static const double SHARE[FIT_ENDS] = {-0.4, 0, 0.4}; // of the band, from its middle
    double first = ceil(p->low[0] - p->clock), last = floor(p->high[0] - p->clock);
    first = first > p->shortest ? first : p->shortest;
    const double interval = rint(p->ticks[0] - p->clock + SHARE[end] * (p->high[0] - p->low[0]));
    *s = (struct fit_segment){1, interval < first ? first : interval > last ? last : interval, 0};
    return first <= last;
}

// Looks from now on also at the gate that S misses most about step BAD.
static void look_closer(const struct fit_problem *p, struct fit *f, const struct fit_segment *s,
                        uint32_t bad) {
    double worst = beyond_band(p, s, bad), next;
    while (bad + 1 < s->count && (next = beyond_band(p, s, bad + 1)) >= worst)
        bad++, worst = next;
    const double n = bad + 1.0, base = p->clock + n * (f->interval + f->add * 0.5 * (n - 1));
    f->extra_place[f->extra] = (float)(n / f->stride);
    f->extra_low[f->extra] = (float)((p->low[bad] - base) / n);
    f->extra_high[f->extra] = (float)((p->high[bad] - base) / n);
    f->extra++;
}

// A segment with END of which all steps but perhaps the last few are right: how many are.
static uint32_t make_good(const struct fit_problem *p, struct fit *f, int end, struct fit_segment *s) {
    int32_t at = f->stride == 1 ? (int32_t)f->count[end] : (int32_t)f->count[end] / f->stride;
    for (;;) {
        at = last_between(p, f, at, EDGES[end], EDGES[end + 1], f->extra ? NULL : &f->adds[end], s);
        if (!at)
            return 0;
        // Between places, and up to the last step when that is near, it may reach on.
        const uint32_t rest = p->count - s->count, near = s->count / 8 + 1;
        uint32_t most = s->count + (rest <= near ? rest : (uint32_t)f->stride - 1);
        most = most < p->most ? most : p->most;
        const uint32_t good = count_good(p, s, most);
        if (good >= s->count || f->extra == FIT_EXTRA)
            return good;
        look_closer(p, f, s, good);
    }
}

bool VARIANT(step_fit_make)(const struct fit_problem *p, struct fit *f, int end, struct fit_segment *s) {
    if (f->count[end] == 1)
        return single(p, end, s);
    uint32_t count = make_good(p, f, end, s);
    if (!count || s->interval < p->shortest)
        return single(p, end, s);
    if (s->add < 0) { // the last interval is the shortest
        const double most = floor((s->interval - p->shortest) / -s->add) + 1;
        count = most < count ? (uint32_t)most : count;
    }
    s->count = count;
    return true;
}
