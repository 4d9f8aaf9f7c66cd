// SPDX-License-Identifier: Apache-2.0
// Steps into segments, as few as a short look ahead can find.
//
// Always taking the longest segment is not best: it ends at the edge of its band, and where it ends decides
// how far the next one reaches. A few steps less end in the middle, or at the far edge, and the next segment
// makes up for more. (Over a ramp the times bend one way only. There a segment that begins and ends in the
// middle of the band is 1.16 times as long as one that goes from edge to edge, which longest-first settles
// at.) So the search keeps a few ways in parallel, all of equally many segments, ranked by how far they came
// and where in the band they stand.
#include "coordinator/motion/steps/compression/step_arithmetic.h"
#include "coordinator/motion/steps/step_internal.h"

#include <string.h>

enum {
    WAYS = 4,   // that the search keeps
    DEPTH = 48, // segments it looks ahead at most
};
// What an end below, about and above the true time is worth, in shares of the segment's length. Measured on
// sliced files; from 0/0.05/0.05 to 0/0.15/0.15 the number of segments differs by less than 1 %.
static const double END_IS_WORTH[FIT_ENDS] = {0, 0.08, 0.12};
// Ways whose rank is behind the best by more than this share of a segment are given up where a band has many
// ticks: a third less time for 1 % more commands. Where it has few, whole ticks decide who comes through, and
// all are kept.
static const double MARGIN = 0.02;
enum { COARSE_TICKS = 256 }; // half a band at 20 MHz
// What a byte less in every command is worth, in shares of the way. More saves bytes at the price of
// commands.
static const double BYTE_IS_WORTH = 0.003;

// ------------------------------------------------------------------------------------------------- bands

// Fills LOW and HIGH of the first FINAL steps; returns the smallest distance between two steps of
// one direction.
static double make_bands(const struct step_gen *gen, struct stepper *s, size_t final, double next) {
    const struct step_bands bands = {
        .ticks = s->ticks,
        .count = final,
        .before = s->sent_direction ? s->sent_ticks : -HUGE_VAL,
        .next = next,
        .max_error = s->max_error_ticks,
        .low = s->low,
        .high = s->high,
    };
    const double first = s->sent_direction == s->direction ? s->ticks[0] - s->sent_ticks : HUGE_VAL;
    return fmin(first, gen->arithmetic->bands(&bands));
}

// ------------------------------------------------------------------------------------------------- search

// One way to do the first AT steps of a stretch, the last of them at CLOCK.
struct way {
    double clock, rank;
    struct fit_segment segment; // its last
    uint32_t at;
    uint16_t bytes; // of the numbers in its commands
    uint8_t from;   // the way it goes on from, a segment earlier
    uint8_t end;    // where in its band the last step comes
};

// How a way could go on.
struct branch {
    double rank;
    uint8_t from, end;
};

struct search {
    const struct stepper *s;
    double margin; // of ranks, in shares of the best way's last segment
    const struct step_arithmetic *arithmetic;
    size_t begin;   // of the stretch, in the buffer
    uint32_t count; // its steps
    double longest; // segment, ticks
    double force;   // a segment that begins before this time need not wait for steps to come
    struct way ways[DEPTH + 1][WAYS]; // best first
    int found[DEPTH + 1];
    struct fit fits[WAYS]; // of the ways of the level looked at
};

// Returns how many steps a segment may have that begins with the first of COUNT at TICKS.
static uint32_t most_of(const double *ticks, uint32_t count, double longest) {
    uint32_t least = 1, most = count < FIT_COUNT_MAX ? count : FIT_COUNT_MAX;
    if (ticks[most - 1] - ticks[0] <= longest)
        return FIT_COUNT_MAX;
    while (least < most) {
        const uint32_t middle = (least + most + 1) / 2;
        if (ticks[middle - 1] - ticks[0] <= longest)
            least = middle;
        else
            most = middle - 1;
    }
    return least;
}

static struct fit_problem problem_behind(const struct search *q, const struct way *way) {
    const size_t i = q->begin + way->at;
    return (struct fit_problem){
        .ticks = q->s->ticks + i,
        .low = q->s->low + i,
        .high = q->s->high + i,
        .count = q->count - way->at,
        .most = most_of(q->s->ticks + i, q->count - way->at, q->longest),
        .expected = way->segment.count,
        .clock = way->clock,
        .shortest = (double)q->s->pulse_ticks,
    };
}

// Bytes of a number on the wire, see wire/vlq.c: one from −32 to 95, with each more 128 times as many.
static uint32_t size_of(int64_t value) {
    const uint64_t v = (uint64_t)value;
    return 1U + (v + 0x20 >= 0x80) + (v + 0x1000 >= 0x4000) + (v + 0x80000 >= 0x200000) +
           (v + 0x4000000 >= 0x10000000);
}

static uint32_t bytes_of(const struct fit_segment *g) {
    return size_of((int64_t)g->interval) + size_of(g->count) + size_of((int64_t)g->add);
}

static double end_of(const struct fit_segment *g, double clock) {
    return clock + g->interval * g->count + 0.5 * g->add * g->count * (g->count - 1.0);
}

// Of ways of equally many segments: the further the better, and a good end helps the next segment; of those
// that did all steps the one in fewest bytes.
static double rank_of(const struct search *q, uint32_t at, uint32_t count, int end, double bytes) {
    if (at == q->count)
        return 2.0 * at - bytes * BYTE_IS_WORTH;
    return (at + count * END_IS_WORTH[end]) * (1 - BYTE_IS_WORTH * bytes);
}

// Finds how each way of a level could go on. Returns how many branches there are, or -1 when steps to come
// might lead a way further.
static int look_on(struct search *q, int level, struct branch *branches) {
    const double share = 1 / (level + 1.0);
    int found = 0;
    for (int i = 0; i < q->found[level]; i++) {
        const struct way *way = &q->ways[level][i];
        const struct fit_problem p = problem_behind(q, way);
        struct fit *fit = &q->fits[i];
        q->arithmetic->fit_find(&p, fit);
        if (fit->open && !(p.ticks[0] < q->force))
            return -1;
        const double bytes = way->bytes + size_of((int64_t)fit->interval) + size_of((int64_t)fit->add);
        for (int end = 0; end < FIT_ENDS; end++) {
            const uint32_t count = fit->count[end];
            if (count)
                branches[found++] =
                    (struct branch){rank_of(q, way->at + count, count, end, (bytes + size_of(count)) * share),
                                    (uint8_t)i, (uint8_t)end};
        }
    }
    return found;
}

// Takes the best of COUNT branches out.
static struct branch take_best(struct branch *branches, int count) {
    int best = 0;
    for (int i = 1; i < count; i++)
        best = branches[i].rank > branches[best].rank ? i : best;
    const struct branch taken = branches[best];
    branches[best].rank = -HUGE_VAL;
    return taken;
}

// Two ways that end at the same step, and within so much of its band, are one.
static const double SAME = 1.0 / 16;

static bool is_new(const struct search *q, const struct way *ways, int count, const struct way *way) {
    const size_t last = q->begin + way->at - 1;
    const double same = SAME * (q->s->high[last] - q->s->low[last]);
    for (int i = 0; i < count; i++)
        if (ways[i].at == way->at && fabs(ways[i].clock - way->clock) < same)
            return false;
    return true;
}

// Whether one of COUNT better ways comes to about the same: to step AT with END.
static bool is_known(const struct way *ways, int count, uint32_t at, int end) {
    for (int i = 0; i < count; i++)
        if (ways[i].at == at && ways[i].end == end)
            return true;
    return false;
}

// What a way must come to, given the best, to be followed.
static double least_rank(const struct search *q, const struct way *best) {
    return best->rank - q->margin * best->segment.count;
}

// Goes on with the best branches. Returns whether a way did all steps; it is the first then.
static bool go_on(struct search *q, int level, struct branch *branches, int count) {
    const double share = 1 / (level + 1.0);
    struct way *ways = q->ways[level + 1];
    int found = 0;
    for (int left = count; left > 0; left--) {
        const struct branch branch = take_best(branches, count);
        if ((found && branch.rank < least_rank(q, ways)) ||
            (found == WAYS && branch.rank <= ways[WAYS - 1].rank))
            break;
        const struct way *before = &q->ways[level][branch.from];
        const struct fit_problem p = problem_behind(q, before);
        struct way way = {.from = branch.from, .end = branch.end};
        struct fit *fit = &q->fits[way.from];
        if (is_known(ways, found, before->at + fit->count[way.end], way.end) ||
            !q->arithmetic->fit_make(&p, fit, way.end, &way.segment))
            continue;
        way.at = before->at + way.segment.count;
        way.clock = end_of(&way.segment, before->clock);
        if (!is_new(q, ways, found, &way))
            continue;
        way.bytes = (uint16_t)(before->bytes + bytes_of(&way.segment));
        way.rank = rank_of(q, way.at, way.segment.count, way.end, way.bytes * share);
        if (found == WAYS && way.rank <= ways[WAYS - 1].rank)
            continue;
        int place = found < WAYS ? found++ : WAYS - 1;
        for (; place > 0 && ways[place - 1].rank < way.rank; place--)
            ways[place] = ways[place - 1];
        ways[place] = way;
    }
    while (found > 1 && ways[found - 1].rank < least_rank(q, ways))
        found--;
    q->found[level + 1] = found;
    return found && ways[0].at == q->count;
}

// Whether the last segment of WAY, which may be as long as a slow move where nothing limits it, has to be on
// its way.
static bool is_urgent(const struct search *q, const struct way *way) {
    return q->s->ticks[q->begin + way->at - way->segment.count] < q->force;
}

// Returns how many segments the best way has that is certain; the way is the first of that level.
static int search(struct search *q, double clock, uint32_t expected) {
    q->ways[0][0] = (struct way){.clock = clock, .segment = {.count = expected}};
    q->found[0] = 1;
    for (int level = 0; level < DEPTH; level++) {
        struct branch branches[WAYS * FIT_ENDS];
        const int count = look_on(q, level, branches);
        if (count < 0) // the last choice may still become a better one, if it has time
            return level > 1 && !is_urgent(q, &q->ways[level][0]) ? level - 1 : level;
        if (go_on(q, level, branches, count))
            return level + 1;
        if (!q->found[level + 1])
            return level;
    }
    return DEPTH;
}

// ---------------------------------------------------------------------------------------------- segments

static void count_segment(struct stepper *s, const struct segment *g, double worst) {
    s->stats.steps += g->count;
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
    if (s->direction < 0)
        g->flags |= SEGMENT_BACK;
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
    ring_make_room(s->segments, sizeof(*s->segments), s->segments_from, s->segments_to, &s->segment_room,
                   STEP_SEGMENTS);
    *step_segment(s, s->segments_to++) = *g;
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
        if (s->segments_to - s->segments_from == STEP_SEGMENTS)
            return STEP_STALLED;
        const struct way *way = &q->ways[level][chosen[level]];
        const int64_t clock = (int64_t)q->ways[level - 1][chosen[level - 1]].clock;
        struct segment g = level == 1 ? *first : (struct segment){0};
        double worst;
        send(s, *from, &g, clock, &way->segment);
        const struct replay steps = {
            .clock = clock,
            .interval = g.interval,
            .count = g.count,
            .add = g.add,
            .shortest = s->pulse_ticks,
            .finish = g.finish - s->base,
            .ticks = s->ticks + *from,
            .low = s->low + *from,
            .high = s->high + *from,
        };
        if (!gen->arithmetic->replay(&steps, &worst))
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
        q.s = s, q.arithmetic = gen->arithmetic, q.begin = *from, q.count = (uint32_t)(end - *from),
        q.longest = gen->longest_s * s->clock->ticks_per_s, q.force = force,
        q.margin = s->max_error_ticks < COARSE_TICKS ? HUGE_VAL : MARGIN;
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
    const double closest = make_bands(gen, s, final, next), rate = s->clock->ticks_per_s;
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
