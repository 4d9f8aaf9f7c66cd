// SPDX-License-Identifier: Apache-2.0
// Steps into segments, as few as a short look ahead can find.
//
// Always taking the longest segment is not best: it ends at the edge of its band, and where it ends decides
// how far the next one reaches. A few steps less end in the middle, or at the far edge, and the next segment
// makes up for more. (Over a ramp the times bend one way only. There a segment that begins and ends in the
// middle of the band is 1.16 times as long as one that goes from edge to edge, which longest-first settles
// at.) So the search keeps a few ways in parallel, all of equally many segments, ranked by how far they came
// and where in the band they stand.
#include "coordinator/motion/step_fit.h"
#include "coordinator/motion/step_internal.h"

#include <string.h>

enum {
    WAYS = 3,   // that the search keeps
    DEPTH = 48, // segments it looks ahead at most
};
// What an end below, about and above the true time is worth, in shares of the segment's length. Measured on
// sliced files; from 0/0.1/0.1 to 0/0.15/0.25 the number of segments differs by less than 1 %.
static const double END_IS_WORTH[FIT_ENDS] = {0, 0.1, 0.15};
// What a byte less in every command is worth, in shares of the way. More saves bytes at the price of
// commands.
static const double BYTE_IS_WORTH = 0.003;

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

// ------------------------------------------------------------------------------------------------- search

// One way to do the first AT steps of a stretch, the last of them at CLOCK.
struct way {
    uint32_t at;
    uint8_t from;   // the way it goes on from, a segment earlier
    uint16_t bytes; // of the numbers in its commands
    double clock, rank;
    struct fit_segment segment; // its last
};

struct search {
    const struct stepper *s;
    size_t begin;   // of the stretch, in the buffer
    uint32_t count; // its steps
    double force;   // a segment that begins before this time need not wait for steps to come
    struct way ways[DEPTH + 1][WAYS]; // best first
    int found[DEPTH + 1];
};

static struct fit_problem problem_behind(const struct search *q, const struct way *way) {
    const size_t i = q->begin + way->at;
    return (struct fit_problem){
        .ticks = q->s->ticks + i,
        .low = q->s->low + i,
        .high = q->s->high + i,
        .count = q->count - way->at,
        .expected = way->segment.count,
        .clock = way->clock,
        .shortest = (double)q->s->pulse_ticks,
    };
}

// Bytes of a number on the wire, see wire/vlq.c.
static uint32_t size_of(double value) {
    return 1U + (value < -32 || value >= 96) + (value < -4096 || value >= 12288) +
           (value < -524288 || value >= 1572864) + (value < -67108864 || value >= 201326592);
}

static uint16_t bytes_of(const struct fit_segment *g) {
    return (uint16_t)(size_of(g->interval) + size_of(g->count) + size_of(g->add));
}

static double end_of(const struct fit_segment *g, double clock) {
    return clock + g->interval * g->count + 0.5 * g->add * g->count * (g->count - 1.0);
}

// Two ways that end at the same step, and within so much of its band, are one.
static const double SAME = 1.0 / 16;

static void keep(struct way *ways, int *found, struct way way, double band) {
    for (int i = 0; i < *found; i++) {
        if (ways[i].at == way.at && fabs(ways[i].clock - way.clock) < SAME * band)
            return;
        if (way.rank > ways[i].rank) {
            const struct way worse = ways[i];
            ways[i] = way;
            way = worse;
        }
    }
    if (*found < WAYS)
        ways[(*found)++] = way;
}

// Of ways of equally many segments: the further the better, and a good end helps the next segment; of those
// that did all steps the one in fewest bytes.
static double rank_of(const struct search *q, const struct way *way, int end, int level) {
    if (way->at == q->count)
        return 2.0 * q->count - way->bytes * BYTE_IS_WORTH;
    const double came = way->at + way->segment.count * END_IS_WORTH[end];
    return came * (1 - BYTE_IS_WORTH * way->bytes / level);
}

// Goes on from every way of a level. Returns false when steps to come might lead one further.
static bool look_on(struct search *q, int level) {
    struct way *next = q->ways[level + 1];
    int *found = &q->found[level + 1];
    *found = 0;
    for (int i = 0; i < q->found[level]; i++) {
        const struct way *way = &q->ways[level][i];
        const struct fit_problem p = problem_behind(q, way);
        struct fit fit;
        step_fit(&p, &fit);
        if (fit.open && !(p.ticks[0] < q->force))
            return false;
        for (int end = 0; end < FIT_ENDS; end++) {
            const struct fit_segment *g = &fit.end[end];
            if (!g->count)
                continue;
            struct way more = {
                .at = way->at + g->count,
                .from = (uint8_t)i,
                .bytes = (uint16_t)(way->bytes + bytes_of(g)),
                .clock = end_of(g, way->clock),
                .segment = *g,
            };
            more.rank = rank_of(q, &more, end, level + 1);
            keep(next, found, more, p.high[g->count - 1] - p.low[g->count - 1]);
        }
    }
    return true;
}

// Checks the newest segments of a level and drops those of which no step is right. Returns whether a way
// did all steps; it is the first then.
static bool settle_level(struct search *q, int level) {
    struct way *ways = q->ways[level];
    int good = 0, whole = -1;
    for (int i = 0; i < q->found[level]; i++) {
        struct way way = ways[i];
        const struct way *before = &q->ways[level - 1][way.from];
        const struct fit_problem p = problem_behind(q, before);
        if (!step_fit_check(&p, &way.segment))
            continue;
        way.at = before->at + way.segment.count;
        way.clock = end_of(&way.segment, before->clock);
        way.bytes = (uint16_t)(before->bytes + bytes_of(&way.segment));
        if (way.at == q->count && (whole < 0 || way.bytes < ways[whole].bytes))
            whole = good;
        ways[good++] = way;
    }
    q->found[level] = good;
    if (whole > 0)
        ways[0] = ways[whole];
    return whole >= 0;
}

// Returns how many segments the best way has that is certain; the way is the first of that level.
static int search(struct search *q, double clock, uint32_t expected) {
    q->ways[0][0] = (struct way){.clock = clock, .segment = {.count = expected}};
    q->found[0] = 1;
    for (int level = 0; level < DEPTH; level++) {
        if (!look_on(q, level))
            return level > 1 ? level - 1 : level; // so that the last choice can still be a better one
        if (settle_level(q, level + 1))
            return level + 1;
        if (!q->found[level + 1])
            return level;
    }
    return DEPTH;
}

// ---------------------------------------------------------------------------------------------- segments

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
    if (t[count - 1] - t[0] < RESET_GAP)
        return count;
    for (size_t i = 1; i < count; i++)
        if (t[i] - t[i - 1] >= RESET_GAP)
            return i;
    return count;
}

static void send(struct stepper *s, size_t from, struct segment *g, int64_t clock,
                 const struct fit_segment *fit) {
    const int64_t interval = (int64_t)fit->interval, add = (int64_t)fit->add, count = fit->count;
    g->interval = (uint32_t)interval;
    g->count = (uint16_t)count;
    g->add = (int16_t)add;
    g->first = s->base + clock + interval;
    g->finish = s->base + clock + interval * count + add * count * (count - 1) / 2;
    g->req = g->flags & SEGMENT_RESET ? g->reset_clock : s->sent_clock;
    if (g->req < g->first - s->lead_ticks)
        g->req = g->first - s->lead_ticks;
    if (s->sent_direction != s->direction) {
        g->flags |= SEGMENT_SET_DIR;
        if ((s->direction > 0) == (s->config.invert_dir == 0))
            g->flags |= SEGMENT_DIR_VALUE;
        s->stats.direction_changes++;
    }
    s->expected = fit->count;
    s->sent_direction = s->direction;
    s->sent_clock = g->finish;
    s->sent_ticks = s->ticks[from + fit->count - 1];
    s->segments[(s->segment_head + s->segment_count++) % STEP_SEGMENTS] = *g;
}

static void drop_sent(struct stepper *s, size_t sent) {
    if (!sent)
        return;
    s->count -= sent;
    memmove(s->ticks, s->ticks + sent, s->count * sizeof(*s->ticks));
    step_rebase(s, s->sent_clock);
}

// Sends the first DEPTH segments of the best way found. *FROM moves behind them.
static int send_way(struct step_gen *gen, struct search *q, int depth, struct segment *first, size_t *from) {
    struct stepper *s = (struct stepper *)q->s;
    uint8_t chosen[DEPTH + 1];
    chosen[depth] = 0;
    for (int level = depth; level > 0; level--)
        chosen[level - 1] = q->ways[level][chosen[level]].from;
    for (int level = 1; level <= depth; level++) {
        if (s->segment_count == STEP_SEGMENTS)
            return STEP_STALLED;
        const struct way *way = &q->ways[level][chosen[level]];
        const int64_t clock = (int64_t)q->ways[level - 1][chosen[level - 1]].clock;
        struct segment g = level == 1 ? *first : (struct segment){0};
        double worst;
        send(s, *from, &g, clock, &way->segment);
        if (!replay(s, *from, &g, clock, &worst))
            return step_fail(gen, STEP_BAD_CHECK, s, clock_print_time(s->clock, s->ticks[*from], s->base),
                             worst / s->clock->ticks_per_s);
        count_segment(s, &g, worst);
        *from += way->segment.count;
    }
    return STEP_OK;
}

// Sends what is certain of the steps [*FROM, END), between which the stepper does not rest.
static int compress_stretch(struct step_gen *gen, struct stepper *s, size_t *from, size_t end, double force) {
    while (*from < end) {
        struct segment first = {0};
        const int64_t clock = begin_segment(s, *from, &first);
        struct search q;
        q.s = s, q.begin = *from, q.count = (uint32_t)(end - *from), q.force = force;
        const int depth = search(&q, (double)clock, s->expected);
        if (!depth && s->ticks[*from] < force)
            return step_fail(gen, STEP_NO_FIT, s, clock_print_time(s->clock, s->ticks[*from], s->base), 0);
        const int status = send_way(gen, &q, depth, &first, from);
        if (status || depth < DEPTH)
            return status;
    }
    return STEP_OK;
}

int step_compress(struct step_gen *gen, struct stepper *s, size_t final, double next, double force) {
    if (!final)
        return STEP_OK;
    const double closest = make_bands(s, final, next), rate = s->clock->ticks_per_s;
    if (closest < s->closest_ticks - 0.5)
        return step_fail(gen, STEP_TOO_FAST, s, clock_print_time(s->clock, s->ticks[0], s->base),
                         closest / rate);
    if (rate > s->stats.max_step_rate * closest)
        s->stats.max_step_rate = rate / closest;
    int status = STEP_OK;
    size_t from = 0, end = 0;
    while (from == end && end < final && !status) {
        end = from + until_rest(s, from, final - from);
        status = compress_stretch(gen, s, &from, end, end < final ? HUGE_VAL : force);
    }
    drop_sent(s, from);
    return status;
}
