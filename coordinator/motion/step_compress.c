// SPDX-License-Identifier: Apache-2.0
// Steps into segments: the longest (interval, add) from the last clock that meets every step's band.
//
// For a given add, every step bounds the interval from below and above by a whole number; where the bounds
// cross, that add ends. The two steps that crossed also tell on which side a better add lies and how far at
// least (the crossing is linear in add), so a few trials close in on the best one.
#include "coordinator/motion/step_internal.h"

#include <string.h>

enum { ADD_MAX = 32767, TRIALS_MAX = 40 };
// Of the adds that fit, the share not worth searching: it buys few steps.
static const double NOT_WORTH = 0.1;

// Two steps at a time, as the baseline vector units of x86-64 and AArch64 have it.
typedef double pair __attribute__((vector_size(16)));
typedef int64_t mask __attribute__((vector_size(16)));

static inline pair load(const double *at) {
    pair p;
    memcpy(&p, at, sizeof(p));
    return p;
}

// ------------------------------------------------------------------------------------------------- bands

static double half_gap(double max_error, double before, double behind) {
    const double gap = before < behind ? before : behind;
    return 0.5 * gap < max_error ? 0.5 * gap : max_error;
}

// Fills LOW and HIGH of the first FINAL steps; returns the smallest distance between two steps of
// one direction.
static double make_bands(struct stepper *s, size_t final, double next) {
    enum { BLOCK = 4 };
    const double *t = s->ticks, max_error = s->max_error_ticks;
    double before = s->sent_direction ? t[0] - s->sent_ticks : HUGE_VAL;
    const double first = s->sent_direction == s->direction ? before : HUGE_VAL;
    double closest[BLOCK] = {first, first, first, first};
    size_t i = 0;
    for (; i + BLOCK + 1 < final; i += BLOCK) {
        if (i == 0) { // the first step's predecessor is not in the buffer
            const double e = half_gap(max_error, before, t[1] - t[0]);
            s->low[0] = t[0] - e, s->high[0] = t[0] + e;
            i = 1;
        }
        for (int j = 0; j < BLOCK; j++) {
            const double *at = t + i + j;
            const double gap = at[0] - at[-1], behind = at[1] - at[0];
            const double nearer = gap < behind ? gap : behind;
            const double e = 0.5 * nearer < max_error ? 0.5 * nearer : max_error;
            s->low[i + (size_t)j] = at[0] - e;
            s->high[i + (size_t)j] = at[0] + e;
            closest[j] = gap < closest[j] ? gap : closest[j];
        }
    }
    for (; i < final; i++) {
        if (i)
            before = t[i] - t[i - 1];
        const double e = half_gap(max_error, before, (i + 1 < final ? t[i + 1] : next) - t[i]);
        s->low[i] = t[i] - e;
        s->high[i] = t[i] + e;
        if (i)
            closest[0] = before < closest[0] ? before : closest[0];
    }
    return fmin(fmin(closest[0], closest[1]), fmin(closest[2], closest[3]));
}

// ------------------------------------------------------------------------------------------------ one add

struct problem {
    const double *low, *high; // bands of the steps to come
    size_t count;
    double clock;    // of the last step
    double shortest; // interval
};

// How far an add reaches, with the intervals that do, and how the bounds crossed on the step behind.
struct reach {
    size_t count;
    double add, low, high;
    double conflict, slope; // ticks of interval, and its change with add
};

struct bound {
    double whole, exact, slope; // interval >= or <= whole; exact before rounding; d exact / d add
};

// Step K at WANT or later, BENT ticks of its clock coming from the last clock and the add.
static inline void raise(struct bound *low, double bent, double k, double want) {
    if (k * low->whole + bent >= want)
        return;
    low->exact = (want - bent) / k;
    low->whole = (double)(int64_t)low->exact; // at most one below
    low->whole += k * low->whole + bent < want;
    low->slope = -0.5 * (k - 1);
}

static inline void lower(struct bound *high, double bent, double k, double limit) {
    if (k * high->whole + bent <= limit)
        return;
    high->exact = (limit - bent) / k;
    high->whole = (double)(int64_t)high->exact; // at most one above
    high->whole -= k * high->whole + bent > limit;
    high->slope = -0.5 * (k - 1);
}

// With an add below 0 the interval of step K is the shortest so far.
static inline void keep_pulse(struct bound *low, double add, double k, double shortest) {
    if (low->whole + add * (k - 1) >= shortest)
        return;
    low->whole = low->exact = shortest - add * (k - 1);
    low->slope = -(k - 1);
}

enum { BLOCK = 4 };

// Whether the bounds stay as they are through the BLOCK steps behind step I.
static inline bool unchanged(const struct problem *p, size_t i, double add, double low, double high) {
    const double k0 = (double)(int32_t)i, half = 0.5 * add;
    const pair clock = {p->clock, p->clock}, lows = {low, low}, highs = {high, high}, halves = {half, half};
    pair k = {k0 + 1, k0 + 2};
    mask bad = {0, 0};
    for (int j = 0; j < BLOCK; j += 2) {
        const pair bent = clock + halves * k * (k - 1);
        bad |= (k * lows + bent < load(p->low + i + j)) | (k * highs + bent > load(p->high + i + j));
        k += 2;
    }
    return !(bad[0] | bad[1]) && low + add * (k0 + BLOCK - 1) >= p->shortest;
}

static struct reach reach(const struct problem *p, double add) {
    struct bound low = {p->shortest, p->shortest, 0}, high = {4294967295.0, 4294967295.0, 0};
    size_t i = 0;
    while (i < p->count) {
        if (i >= BLOCK && i + BLOCK <= p->count && unchanged(p, i, add, low.whole, high.whole)) {
            i += BLOCK;
            continue;
        }
        const size_t end = i + BLOCK < p->count ? i + BLOCK : p->count;
        for (; i < end; i++) {
            const double k = (double)(int32_t)(i + 1), bent = p->clock + 0.5 * add * k * (k - 1);
            const double low_before = low.whole, high_before = high.whole;
            raise(&low, bent, k, p->low[i]);
            lower(&high, bent, k, p->high[i]);
            if (add < 0)
                keep_pulse(&low, add, k, p->shortest);
            if (low.whole > high.whole)
                return (struct reach){
                    i, add, low_before, high_before, low.exact - high.exact, low.slope - high.slope};
        }
    }
    return (struct reach){i, add, low.whole, high.whole, 0, 0};
}

// --------------------------------------------------------------------------------------------- best add

// Excludes from [*FIRST, *LAST] the adds that cannot reach further than R, R's own at least.
static void cut(const struct reach *r, double *first, double *last) {
    const double way = r->conflict > 0 ? r->conflict / fabs(r->slope) : 0;
    if (r->slope > 0)
        *last = fmin(*last, way >= 1 ? floor(r->add - way) : r->add - 1);
    else
        *first = fmax(*first, way >= 1 ? ceil(r->add + way) : r->add + 1);
}

static struct reach longest(const struct problem *p, double guess) {
    double first = -ADD_MAX - 1, last = ADD_MAX, add = fmin(fmax(guess, first), last);
    bool from_left = false, from_right = false;
    struct reach best = {0, 0, 0, 0, 0, 0};
    for (int trial = 0; trial < TRIALS_MAX; trial++) {
        const struct reach r = reach(p, add);
        if (r.count > best.count)
            best = r;
        if (r.count == p->count || r.slope == 0)
            break;
        *(r.slope > 0 ? &from_right : &from_left) = true;
        cut(&r, &first, &last);
        if (first > last)
            break;
        // About how wide the adds are that keep so many steps in the band: aim at the middle of them.
        const double n = (double)(int32_t)best.count + 1, width = (p->high[0] - p->low[0]) / (n * n);
        if (!(from_left && from_right)) {
            add = from_left ? fmin(last, floor(first + width)) : fmax(first, ceil(last - width));
            continue;
        }
        if (last - first < NOT_WORTH * width)
            break;
        add = floor(0.5 * (first + last));
    }
    return best;
}

// ---------------------------------------------------------------------------------------------- segments

// The add that the true times suggest, over about as many steps as the last segment had.
static double suggest(const struct stepper *s, size_t from, size_t count) {
    const size_t half = (s->guess_count < count ? s->guess_count : count - 1) / 2;
    if (!half)
        return s->guess_add;
    const double *t = s->ticks + from;
    return nearbyint((t[2 * half] - 2 * t[half] + t[0]) / ((double)half * (double)half));
}

// Replays a segment as the node will and compares each clock with the steps. Returns false, or the worst
// error.
static bool replay(const struct stepper *s, size_t from, const struct segment *g, int64_t clock,
                   double *worst) {
    int64_t interval = g->interval, bad = 0;
    double most = 0;
    for (size_t i = from; i < from + g->count; i++) {
        bad |= interval < s->pulse_ticks;
        clock += interval;
        interval += g->add;
        const double at = (double)clock, error = fabs(at - s->ticks[i]);
        bad |= (at < s->low[i]) | (at > s->high[i]);
        most = error > most ? error : most;
    }
    *worst = most;
    return !bad && clock + s->base == g->finish;
}

static void count_segment(struct stepper *s, const struct segment *g, double worst) {
    s->stats.steps += g->count;
    s->stats.issued += s->direction * g->count;
    s->stats.queue_steps++;
    if (worst > s->stats.worst_error_ticks)
        s->stats.worst_error_ticks = worst;
    if (worst > s->stats.worst_error_s * s->clock->ticks_per_s)
        s->stats.worst_error_s = worst / s->clock->ticks_per_s;
}

// Ticks before the first step FROM at which its segment's clock begins; decides about a reset.
static int64_t begin_segment(const struct stepper *s, size_t from, struct segment *g) {
    const int64_t last = s->sent_clock - s->base;
    if (s->sent_direction && s->ticks[from] - (double)last < RESET_GAP)
        return last;
    const int64_t clock = (int64_t)floor(s->ticks[from]) - s->lead_ticks;
    g->flags |= SEGMENT_RESET;
    g->reset_clock = clock + s->base;
    g->reset_min = s->sent_direction ? s->sent_clock + s->reset_margin_ticks : 0;
    return clock;
}

// How many of COUNT steps from FROM on come without a rest that needs a reset.
static size_t until_rest(const struct stepper *s, size_t from, size_t count) {
    const double *t = s->ticks + from;
    count = count < SEGMENT_COUNT_MAX ? count : SEGMENT_COUNT_MAX;
    if (t[count - 1] - t[0] < RESET_GAP)
        return count;
    for (size_t i = 1; i < count; i++)
        if (t[i] - t[i - 1] >= RESET_GAP)
            return i;
    return count;
}

static void send(struct stepper *s, size_t from, struct segment *g, int64_t clock, const struct reach *r) {
    const double k = (double)r->count;
    // Of the intervals that reach equally far the longest: measured on sliced files it leaves the next
    // segment in the best place (2 % fewer than the middle one, 4 % fewer than the shortest).
    const int64_t interval = (int64_t)r->high;
    g->interval = (uint32_t)interval;
    g->count = (uint16_t)r->count;
    g->add = (int16_t)r->add;
    g->first = s->base + clock + interval;
    g->finish = s->base + clock + interval * (int64_t)r->count + (int64_t)(0.5 * r->add * k * (k - 1));
    g->req = g->flags & SEGMENT_RESET ? g->reset_clock : s->sent_clock;
    if (g->req < g->first - s->lead_ticks)
        g->req = g->first - s->lead_ticks;
    if (s->sent_direction != s->direction) {
        g->flags |= SEGMENT_SET_DIR;
        if ((s->direction > 0) == (s->config.invert_dir == 0))
            g->flags |= SEGMENT_DIR_VALUE;
        s->stats.direction_changes++;
    }
    s->guess_add = g->add;
    s->guess_count = r->count;
    s->sent_direction = s->direction;
    s->sent_clock = g->finish;
    s->sent_ticks = s->ticks[from + r->count - 1];
    s->segments[(s->segment_head + s->segment_count++) % STEP_SEGMENTS] = *g;
}

static void drop_sent(struct stepper *s, size_t sent) {
    if (!sent)
        return;
    s->count -= sent;
    memmove(s->ticks, s->ticks + sent, s->count * sizeof(*s->ticks));
    step_rebase(s, s->sent_clock);
}

int step_compress(struct step_gen *gen, struct stepper *s, size_t final, double next, double force) {
    if (!final)
        return STEP_OK;
    const double closest = make_bands(s, final, next);
    const double rate = s->clock->ticks_per_s;
    if (closest < s->closest_ticks - 0.5)
        return step_fail(gen, STEP_TOO_FAST, s, clock_print_time(s->clock, s->ticks[0], s->base),
                         closest / rate);
    if (rate > s->stats.max_step_rate * closest)
        s->stats.max_step_rate = rate / closest;
    int status = STEP_OK;
    size_t from = 0;
    while (from < final && !status) {
        if (s->segment_count == STEP_SEGMENTS) {
            status = STEP_STALLED;
            break;
        }
        struct segment g = {0};
        const size_t count = until_rest(s, from, final - from);
        const int64_t clock = begin_segment(s, from, &g);
        const struct problem problem = {s->low + from, s->high + from, count, (double)clock,
                                        (double)s->pulse_ticks};
        const struct reach r = longest(&problem, suggest(s, from, count));
        if (r.count == final - from && r.count < SEGMENT_COUNT_MAX && !(s->ticks[from] < force))
            break;
        const double print_time = clock_print_time(s->clock, s->ticks[from], s->base);
        if (!r.count)
            return step_fail(gen, STEP_NO_FIT, s, print_time, 0);
        double worst;
        send(s, from, &g, clock, &r);
        if (!replay(s, from, &g, clock, &worst))
            return step_fail(gen, STEP_BAD_CHECK, s, print_time, worst / rate);
        count_segment(s, &g, worst);
        from += r.count;
    }
    drop_sent(s, from);
    return status;
}
