// SPDX-License-Identifier: Apache-2.0
// The generator as a whole: memory, moves in, time forward.
#include "coordinator/motion/steps/compression/step_arithmetic.h"
#include "coordinator/motion/steps/step_change.h"

#include <string.h>

static const double SLICE_S = 0.25;       // steppers of a node advance together by so much
static const double GROW_S = 0.5;         // how long a segment may wait for more while more is to come
static const double PIVOT_S = 600;        // after which a clock is measured from a newer time
static const double ROUNDING_MM_S = 1e-6; // of speeds

// ------------------------------------------------------------------------------------------------ memory

static bool is_legal(const struct step_config *c) {
    bool ok = c->stepper_count >= 0 && c->stepper_count <= STEP_MAX_STEPPERS && c->node_count >= 0 &&
              c->node_count <= STEP_MAX_NODES && step_in_range(c->max_error_s, 0, 1) && c->longest_s >= 0;
    for (int i = 0; ok && i < AXES; i++)
        ok = fabs(c->start[i]) < LONGEST_S;
    for (int i = 0; ok && i < c->node_count; i++)
        ok = step_in_range(c->nodes[i].clock_freq, 0, FASTEST_HZ) &&
             c->max_error_s * c->nodes[i].clock_freq >= 1 &&
             step_in_range(c->nodes[i].move_count, 0, STEP_MOVE_COUNT_MAX);
    for (int i = 0; ok && i < c->stepper_count; i++) {
        const struct step_stepper_config *s = &c->steppers[i];
        ok = s->node >= 0 && s->node < c->node_count && step_in_range(s->step_distance, 0, LONGEST_S) &&
             step_in_range(s->step_pulse_s, -1e-300, 1) && s->oid >= 0 && s->oid <= UINT8_MAX;
        for (int j = 0; ok && j < AXES; j++)
            ok = fabs(s->weights[j]) < LONGEST_S;
        for (int j = 0; ok && j < STEP_PARAMS; j++)
            ok = fabs(s->params[j]) < LONGEST_S;
    }
    return ok;
}

// Hands out pieces of one block of memory, or only counts when AT is NULL.
struct arena {
    uint8_t *at;
    size_t used;
};

static void *piece(struct arena *arena, size_t count, size_t size) {
    void *p = arena->at ? arena->at + arena->used : NULL;
    arena->used += (count * size + 15) & ~(size_t)15;
    return p;
}

static void carve_stepper(struct arena *arena, struct stepper *s) {
    double *ticks = piece(arena, STEP_BUFFER + BUFFER_PAD, sizeof(double));
    double *low = piece(arena, STEP_BUFFER + BUFFER_PAD, sizeof(double));
    double *high = piece(arena, STEP_BUFFER + BUFFER_PAD, sizeof(double));
    struct segment *segments = piece(arena, STEP_SEGMENTS, sizeof(struct segment));
    if (s)
        s->ticks = ticks, s->low = low, s->high = high, s->segments = segments,
        s->segment_room = RING_FIRST_ROOM;
}

static void carve_node(struct arena *arena, struct node *node, size_t slots) {
    uint64_t *slot = piece(arena, slots, sizeof(uint64_t));
    uint64_t *busy = piece(arena, slots, sizeof(uint64_t));
    uint8_t *out = piece(arena, STEP_OUT_BYTES, 1);
    if (!node)
        return;
    node->slots = (struct clocks){.at = slot, .room = (uint32_t)slots};
    node->busy = (struct clocks){.at = busy, .room = (uint32_t)slots};
    node->out = out;
}

static struct step_gen *carve(struct arena *arena, const struct step_config *c) {
    struct step_gen *gen = piece(arena, 1, sizeof(*gen));
    struct stepper *steppers = piece(arena, (size_t)c->stepper_count, sizeof(*steppers));
    struct node *nodes = piece(arena, (size_t)c->node_count, sizeof(*nodes));
    struct trapezoid *moves = piece(arena, STEP_TRAPEZOIDS, sizeof(*moves));
    double *tables = piece(arena, (size_t)9 * STEP_TABLE_POINTS, sizeof(*tables));
    if (gen) {
        memset(gen, 0, (size_t)((uint8_t *)moves - (uint8_t *)gen));
        gen->steppers = steppers, gen->nodes = nodes, gen->moves = moves;
        gen->move_room = RING_FIRST_ROOM;
        for (size_t i = 0; i < 3; i++)
            gen->table_values[i] = tables + i * 3 * STEP_TABLE_POINTS;
    }
    for (int i = 0; i < c->stepper_count; i++)
        carve_stepper(arena, gen ? &steppers[i] : NULL);
    for (int i = 0; i < c->node_count; i++)
        carve_node(arena, gen ? &nodes[i] : NULL, (size_t)c->nodes[i].move_count);
    return gen;
}

size_t step_gen_size(const struct step_config *config) {
    struct arena counter = {NULL, 0};
    if (!is_legal(config))
        return 0;
    carve(&counter, config);
    return counter.used;
}

struct step_gen *step_gen_init(void *memory, const struct step_config *config) {
    struct arena arena = {memory, 0};
    if (!is_legal(config))
        return NULL;
    struct step_gen *gen = carve(&arena, config);
    gen->stepper_count = config->stepper_count;
    gen->node_count = config->node_count;
    gen->arithmetic = step_arithmetic();
    gen->max_error_s = config->max_error_s;
    gen->longest_s = config->longest_s > 0 ? config->longest_s : HUGE_VAL;
    gen->moves_end = -LONGEST_S;
    gen->error.stepper = -1;
    memcpy(gen->rest, config->start, sizeof(gen->rest));
    for (int i = 0; i < 3; i++)
        gen->shapers[i] = (struct shaper){.n = 1, .amplitude = {1}};
    step_make_taps(gen);
    gen->assumed = -LONGEST_S;
    for (int i = 0; i < gen->node_count; i++) {
        gen->nodes[i].config = config->nodes[i];
        gen->nodes[i].clock.ticks_per_s = config->nodes[i].clock_freq;
    }
    for (int i = 0; i < gen->stepper_count; i++) {
        struct stepper *s = &gen->steppers[i];
        s->config = config->steppers[i];
        struct node *node = &gen->nodes[s->config.node];
        s->clock = &node->clock;
        s->origin = step_absolute(gen, s, config->start);
        if (!(fabs(s->origin) < 1e12))
            return NULL;
        step_set_tick_limits(s, config->max_error_s);
        step_choose_way(gen, s);
        step_make_prefix(&s->queue_step, node->config.queue_step_id, s->config.oid);
        step_make_prefix(&s->set_dir, node->config.set_next_step_dir_id, s->config.oid);
        step_make_prefix(&s->reset_clock, node->config.reset_step_clock_id, s->config.oid);
    }
    return gen;
}

int step_fail(struct step_gen *gen, enum step_status status, const struct stepper *stepper, double print_time,
              double value) {
    gen->error = (struct step_error){(int32_t)status, stepper ? (int32_t)(stepper - gen->steppers) : -1,
                                     print_time, value};
    return (int)status;
}

// ----------------------------------------------------------------------------------------------- moves in

static bool is_between(double value, double low) {
    return value >= low && value < LONGEST_S; // false for NaN
}

// Speeds and durations that planning's rounding left a little below 0 count as 0.
static double *clip(double *value, double tolerance) {
    if (*value < 0 && *value >= -tolerance)
        *value = 0;
    return value;
}

static bool move_is_legal(struct trapezoid *m) {
    bool ok = fabs(m->print_time) < LONGEST_S && is_between(m->accel, 0);
    double *durations[] = {&m->accel_s, &m->cruise_s, &m->decel_s};
    for (int i = 0; i < 3; i++)
        ok = ok && is_between(*clip(durations[i], ROUNDING_S), 0);
    for (int i = 0; i < AXES; i++)
        ok = ok && fabs(m->start[i]) < LONGEST_S && fabs(m->ratio[i]) < LONGEST_S;
    return ok && is_between(*clip(&m->start_v, ROUNDING_MM_S), 0) &&
           is_between(*clip(&m->cruise_v, ROUNDING_MM_S), 0) &&
           m->cruise_v - m->accel * m->decel_s >= -ROUNDING_MM_S * (1 + m->cruise_v);
}

static void keep(void *context, const struct trapezoid *move) {
    struct step_gen *gen = context;
    ring_make_room(gen->moves, sizeof(*gen->moves), gen->kept_from, gen->moves_to, &gen->move_room,
                   STEP_TRAPEZOIDS);
    *step_move(gen, gen->moves_to++) = *move;
    gen->moves_end = move_end(move);
}

// Appends a move as its pieces; returns 0 when they may have no room, or a negative step_status.
static int append_corrected(struct step_gen *gen, const struct trapezoid *m) {
    const uint64_t most = (uint64_t)step_table_most_pieces(gen->tables, m);
    if (gen->moves_to - gen->kept_from + most > STEP_TRAPEZOIDS)
        return gen->moves_from < gen->moves_to ? 0 : -step_fail(gen, STEP_TOO_DENSE, NULL, m->print_time, 0);
    step_table_cut(gen->tables, m, keep, gen);
    gen->corrected = step_table_acts(gen->tables);
    return 1;
}

int step_append(struct step_gen *gen, const struct trapezoid *moves, int n) {
    int taken = 0;
    for (; taken < n && gen->moves_to - gen->kept_from < STEP_TRAPEZOIDS; taken++) {
        struct trapezoid m = moves[taken];
        if (!move_is_legal(&m))
            return -step_fail(gen, STEP_BAD_MOVE, NULL, m.print_time, taken);
        const double earliest = step_next_move(gen);
        if (m.print_time < earliest - ROUNDING_S)
            return -step_fail(gen, STEP_BAD_ORDER, NULL, m.print_time, earliest);
        if (!gen->corrected) {
            keep(gen, &m);
            continue;
        }
        const int status = append_corrected(gen, &m);
        if (status <= 0)
            return status ? status : taken;
    }
    return taken;
}

// -------------------------------------------------------------------------------------------- time forward

// Compresses what waits once the steps before UNTIL are there: all of it (FLUSH), or what comes before FORCE.
static int settle(struct step_gen *gen, struct stepper *s, double until_s, double force_s, bool flush) {
    if (!s->count)
        return STEP_OK;
    until_s = s->curve ? s->border : until_s;
    force_s -= s->reach;
    const double until = clock_relative(s->clock, until_s, s->base), last = s->ticks[s->count - 1];
    if (flush)
        return step_compress(gen, s, s->count, fmax(until, last + s->closest_ticks), HUGE_VAL);
    const double force = clock_relative(s->clock, force_s, s->base);
    if (s->ticks[0] >= force)
        return STEP_OK;
    // The last step may still cancel, or get a close neighbour.
    if (until - last >= 2 * s->max_error_ticks + s->closest_ticks)
        return step_compress(gen, s, s->count, until, force);
    return step_compress(gen, s, s->count - 1, last, force);
}

// Brings every stepper to the slice's end. Returns an error, or STEP_STALLED when one has no room.
static int advance(struct step_gen *gen, double force_s, bool flush) {
    int result = STEP_OK;
    for (struct stepper *s = gen->steppers; s < gen->steppers + gen->stepper_count; s++) {
        s->border = fmax(s->border, fmin(gen->slice, gen->known - s->reach));
        int status =
            s->curve ? step_curve_advance(gen, s, s->border) : step_times_advance(gen, s, gen->slice);
        if (!status)
            status = settle(gen, s, gen->slice, force_s, flush);
        if (status && status != STEP_STALLED)
            return status;
        if (status)
            result = status;
    }
    return result;
}

static void finish_slice(struct step_gen *gen) {
    gen->until = gen->slice;
    while (gen->moves_from < gen->moves_to && is_over(move_end(step_move(gen, gen->moves_from)), gen->until))
        gen->moves_from++;
    const double past = gen->until - step_look_ahead(gen) - step_lag(gen) - ROUNDING_S;
    for (; gen->kept_from < gen->moves_from; gen->kept_from++) {
        const struct trapezoid *m = step_move(gen, gen->kept_from);
        if (move_end(m) > past && step_look_ahead(gen) + step_lag(gen) > 0)
            break;
        step_move_end_position(m, gen->rest);
    }
    for (int i = 0; i < gen->node_count; i++)
        if (gen->until - gen->nodes[i].clock.time > PIVOT_S)
            step_set_clock(gen, i, gen->nodes[i].clock.ticks_per_s);
}

static bool jammed(const struct step_gen *gen) {
    bool any = false;
    for (int i = 0; i < gen->node_count; i++)
        any |= gen->nodes[i].jammed;
    return any;
}

// One slice up to gen->slice. A stepper without room for segments waits for slower ones of its node, whose
// segments are then cut short.
static int run_slice(struct step_gen *gen, double force_s, bool flush) {
    for (;;) {
        const int status = advance(gen, force_s, flush);
        if (status && status != STEP_STALLED)
            return status;
        const size_t moved = step_merge(gen, flush && !status);
        if (!status)
            return STEP_OK;
        if (moved)
            continue;
        if (jammed(gen))
            return STEP_FULL;
        if (force_s >= gen->slice)
            return step_fail(gen, STEP_TOO_DENSE, NULL, gen->slice, 0);
        force_s = gen->slice;
    }
}

double step_next_move(const struct step_gen *gen) {
    return fmax(fmax(gen->moves_end, gen->slice), gen->assumed);
}

// The end of the next slice: a long rest is one slice.
static double next_slice(const struct step_gen *gen, double until) {
    double end = gen->until + SLICE_S;
    if (gen->moves_from == gen->moves_to)
        end = until;
    else
        end = fmax(end, step_move(gen, gen->moves_from)->print_time);
    return fmax(fmin(end, until), gen->until);
}

int step_generate(struct step_gen *gen, double until, int flush) {
    if (!(fabs(until) < LONGEST_S))
        return step_fail(gen, STEP_BAD_ORDER, NULL, until, gen->until);
    if (gen->error.status)
        return gen->error.status;
    gen->known = flush ? LONGEST_S : fmax(until, gen->moves_end);
    for (;;) {
        if (gen->slice <= gen->until)
            gen->slice = next_slice(gen, until);
        const bool last = gen->slice >= until;
        const int status = run_slice(gen, gen->slice - (last ? STEP_HOLD_S : GROW_S), last && flush);
        if (status)
            return status;
        finish_slice(gen);
        if (last && flush)
            step_assume_rest(gen);
        if (last)
            return jammed(gen) ? STEP_FULL : STEP_OK;
    }
}

double step_generated_until(const struct step_gen *gen) {
    return gen->until;
}

// --------------------------------------------------------------------------------------------- statistics

void step_stepper_stats(const struct step_gen *gen, int stepper, struct step_stepper_stats *out) {
    *out = gen->steppers[stepper].stats;
    out->position = gen->steppers[stepper].position;
}

void step_node_stats(const struct step_gen *gen, int node, struct step_node_stats *out) {
    *out = gen->nodes[node].stats;
    out->waiting_bytes = (uint32_t)(gen->nodes[node].out_to - gen->nodes[node].out_from);
}

void step_last_error(const struct step_gen *gen, struct step_error *out) {
    *out = gen->error;
}
