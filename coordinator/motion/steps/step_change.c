// SPDX-License-Identifier: Apache-2.0
// What may change while the generator runs: clocks, where the axes stand, shapers, weights, windows.
#include "coordinator/motion/steps/step_change.h"

#include <string.h>

// ------------------------------------------------------------------------------------------------- clocks

void step_set_tick_limits(struct stepper *s, double max_error_s) {
    const double rate = s->clock->ticks_per_s;
    s->max_error_ticks = max_error_s * rate;
    s->pulse_ticks = (int64_t)ceil(2 * s->config.step_pulse_s * rate);
    s->pulse_ticks = s->pulse_ticks > 1 ? s->pulse_ticks : 1;
    s->closest_ticks = (double)(s->pulse_ticks + STEP_SLACK_TICKS);
    s->lead_ticks = (int64_t)fmin(STEP_LEAD_S * rate, RESET_GAP / 2.0);
    s->reset_margin_ticks = (int64_t)fmin(STEP_RESET_MARGIN_S * rate, RESET_GAP / 4.0);
}

static void set_rate(struct step_gen *gen, struct node *node, double ticks_per_s) {
    node->clock.ticks_per_s = ticks_per_s;
    for (struct stepper *s = gen->steppers; s < gen->steppers + gen->stepper_count; s++)
        if (s->clock == &node->clock)
            step_set_tick_limits(s, gen->max_error_s);
}

static bool is_clock(const struct step_gen *gen, int node, double ticks_per_s) {
    return node >= 0 && node < gen->node_count && step_in_range(ticks_per_s, 0, FASTEST_HZ) &&
           gen->max_error_s * ticks_per_s >= 1;
}

int step_set_clock_base(struct step_gen *gen, int index, double time, int64_t ticks, double ticks_per_s) {
    if (!is_clock(gen, index, ticks_per_s) || !(fabs(time) < LONGEST_S) || ticks < 0)
        return STEP_BAD_CLOCK;
    struct node *node = &gen->nodes[index];
    for (struct stepper *s = gen->steppers; s < gen->steppers + gen->stepper_count; s++)
        if (s->clock == &node->clock && s->count)
            return STEP_NOT_IDLE;
    node->clock = (struct clock_map){time, 0, ticks_per_s, ticks};
    set_rate(gen, node, ticks_per_s);
    return STEP_OK;
}

int step_set_clock(struct step_gen *gen, int index, double ticks_per_s) {
    if (!is_clock(gen, index, ticks_per_s))
        return STEP_BAD_CLOCK;
    if (gen->slice > gen->until)
        return STEP_NOT_IDLE;
    struct clock_map *map = &gen->nodes[index].clock;
    const double passed = (gen->until - map->time) * map->ticks_per_s + map->part, whole = floor(passed);
    map->whole += (int64_t)whole;
    map->part = passed - whole;
    map->time = gen->until;
    set_rate(gen, &gen->nodes[index], ticks_per_s);
    return STEP_OK;
}

int64_t step_clock_at(const struct step_gen *gen, int index, double print_time) {
    const struct clock_map *map = &gen->nodes[index].clock;
    return map->whole + (int64_t)floor(clock_relative(map, print_time, map->whole));
}

// --------------------------------------------------------------------------------------------- positions

static double mix(const double *weights, const double *position) {
    double sum = 0;
    for (int i = 0; i < AXES; i++)
        sum += weights[i] * position[i];
    return sum;
}

double step_absolute(const struct step_gen *gen, struct stepper *s, const double *position) {
    double at[AXES], still[AXES] = {0}, speed;
    memcpy(at, position, sizeof(at));
    if (s->follows_bed)
        step_surface_add(&gen->surface, at, still, NULL);
    if (!s->config.formula)
        return mix(s->config.weights, at) / s->config.step_distance;
    s->angle = s->config.formula->position(s->config.params, s->angle, at, still, &speed);
    return s->angle / s->config.step_distance;
}

// The steppers stand at POSITION, corrections included.
static int set_motor_position(struct step_gen *gen, const double *position) {
    if (gen->moves_from < gen->moves_to || gen->slice > gen->until)
        return STEP_NOT_IDLE;
    for (int i = 0; i < AXES; i++)
        if (!(fabs(position[i]) < LONGEST_S))
            return STEP_BAD_CONFIG;
    const bool settled = step_settled(gen);
    double shift[AXES];
    step_end_position(gen, shift);
    for (int i = 0; i < AXES; i++)
        shift[i] = position[i] - shift[i];
    for (struct stepper *s = gen->steppers; s < gen->steppers + gen->stepper_count; s++)
        if (!settled && s->curve && (s->config.formula || s->follows_bed))
            return STEP_NOT_IDLE;
    for (struct stepper *s = gen->steppers; s < gen->steppers + gen->stepper_count; s++)
        if (!settled && s->curve)
            s->origin += mix(s->config.weights, shift) / s->config.step_distance;
        else
            s->origin = step_absolute(gen, s, position) - (double)s->position;
    for (struct stepper *s = gen->steppers; s < gen->steppers + gen->stepper_count; s++)
        step_forget(s);
    // Moves that still act are shifted, as if they had led here.
    for (uint64_t i = gen->kept_from; i < gen->moves_to; i++)
        for (int j = 0; j < AXES; j++)
            step_move(gen, i)->start[j] += shift[j];
    for (int j = 0; j < AXES; j++)
        gen->rest[j] += shift[j];
    return STEP_OK;
}

// ------------------------------------------------------------------------------------------ corrections

static bool all_generated(const struct step_gen *gen) {
    return gen->moves_from == gen->moves_to && gen->slice <= gen->until;
}

// Where the axes stand, without what is added to them.
static void planned_position(const struct step_gen *gen, double *position) {
    step_end_position(gen, position);
    for (int i = 0; i < 3; i++)
        position[i] -= gen->tables[i].offset;
}

int step_set_axis_position(struct step_gen *gen, const double *position) {
    const int status = set_motor_position(gen, position);
    if (status)
        return status;
    for (int i = 0; i < 3; i++) {
        gen->tables[i].reverse = 0;
        step_table_stand(&gen->tables[i], position[i], 0);
    }
    gen->corrected = step_table_acts(gen->tables);
    return STEP_OK;
}

int step_set_corrections(struct step_gen *gen, const double *offset, const int32_t *reverse) {
    double planned[AXES], motor[AXES];
    planned_position(gen, planned);
    memcpy(motor, planned, sizeof(motor));
    for (int i = 0; i < 3; i++)
        motor[i] += offset[i];
    const int status = set_motor_position(gen, motor);
    if (status)
        return status;
    for (int i = 0; i < 3; i++) {
        gen->tables[i].reverse = reverse[i] != 0;
        step_table_stand(&gen->tables[i], planned[i], offset[i]);
    }
    gen->corrected = step_table_acts(gen->tables);
    return STEP_OK;
}

static bool table_is_legal(int n, const double *position, const double *forward, const double *reverse) {
    bool ok = n >= 0 && n != 1 && n <= STEP_TABLE_POINTS;
    for (int i = 0; ok && i < n; i++)
        ok = fabs(position[i]) < LONGEST_S && fabs(forward[i]) < LONGEST_S && fabs(reverse[i]) < LONGEST_S &&
             (i == 0 || position[i] > position[i - 1]);
    return ok;
}

// A quarter of what the slowest pulses of the axis's steppers allow is left for taking up.
static double possible_take_up(const struct step_gen *gen, int axis, double take_up) {
    for (const struct stepper *s = gen->steppers; s < gen->steppers + gen->stepper_count; s++) {
        const double weight = fabs(s->config.weights[axis]);
        const double fastest = s->config.step_distance / s->closest_ticks * s->clock->ticks_per_s;
        if (!s->config.formula && weight > 0)
            take_up = fmin(take_up, fastest / weight / 4);
    }
    return take_up;
}

int step_set_table(struct step_gen *gen, int axis, int n, const double *position, const double *forward,
                   const double *reverse, double take_up) {
    if (axis < AXIS_X || axis > AXIS_Z || !step_in_range(take_up, 0, LONGEST_S) ||
        !table_is_legal(n, position, forward, reverse))
        return STEP_BAD_CONFIG;
    if (!all_generated(gen))
        return STEP_NOT_IDLE;
    double planned[AXES], *values = gen->table_values[axis],
                          *reverses = values + (size_t)2 * STEP_TABLE_POINTS;
    planned_position(gen, planned);
    const size_t size = (size_t)n * sizeof(*values);
    if (size) {
        memcpy(values, position, size);
        memcpy(values + STEP_TABLE_POINTS, forward, size);
        memcpy(reverses, reverse, size);
    }
    struct axis_table *t = &gen->tables[axis];
    t->n = n, t->position = values, t->side[0] = values + STEP_TABLE_POINTS;
    t->side[1] = reverses, t->take_up = possible_take_up(gen, axis, take_up);
    step_table_stand(t, planned[axis], t->offset);
    gen->corrected = step_table_acts(gen->tables);
    return STEP_OK;
}

int step_get_correction(const struct step_gen *gen, int axis, struct step_correction *out) {
    if (axis < AXIS_X || axis > AXIS_Z)
        return STEP_BAD_CONFIG;
    const struct axis_table *t = &gen->tables[axis];
    *out = (struct step_correction){t->n, t->reverse, t->offset, t->lag};
    return STEP_OK;
}

// -------------------------------------------------------------------------- shapers, weights and windows

void step_assume_rest(struct step_gen *gen) {
    if (gen->until + step_look_ahead(gen) > gen->moves_end)
        gen->assumed = fmax(gen->assumed, gen->until + step_look_ahead(gen));
}

static bool may_change(const struct step_gen *gen) {
    return gen->moves_from == gen->moves_to && gen->slice <= gen->until && step_settled(gen);
}

// All stands: what was before does not matter any more.
static void start_afresh(struct step_gen *gen) {
    step_end_position(gen, gen->rest);
    gen->kept_from = gen->moves_to;
    for (struct stepper *s = gen->steppers; s < gen->steppers + gen->stepper_count; s++) {
        s->move = gen->moves_to;
        s->time = s->border = fmax(gen->until, s->time);
        step_choose_way(gen, s);
    }
    step_assume_rest(gen);
}

int step_set_shaper(struct step_gen *gen, int axis, int n, const double *amplitude, const double *time_s) {
    struct shaper shaper = {.n = n};
    double sum = 0, centre = 0;
    if (axis < AXIS_X || axis > AXIS_Z || n < 1 || n > STEP_IMPULSES)
        return STEP_BAD_CONFIG;
    for (int i = 0; i < n; i++) {
        if (!(fabs(amplitude[i]) <= 10 && fabs(time_s[i]) <= 1))
            return STEP_BAD_CONFIG;
        shaper.amplitude[i] = amplitude[i];
        shaper.time[i] = time_s[i];
        sum += amplitude[i];
        centre += amplitude[i] * time_s[i];
    }
    if (!(fabs(sum - 1) < 1e-9 && fabs(centre) < 1e-9))
        return STEP_BAD_CONFIG;
    if (!may_change(gen))
        return STEP_NOT_IDLE;
    gen->shapers[axis] = shaper;
    step_make_taps(gen);
    start_afresh(gen);
    return STEP_OK;
}

// Smoothing of E is for sums of axes; a stepper that follows a bed is none.
static bool moves_z_and_e(const double *weights) {
    return weights[AXIS_Z] != 0 && weights[AXIS_E] != 0;
}

int step_set_weights(struct step_gen *gen, int stepper, const double *weights) {
    if (stepper < 0 || stepper >= gen->stepper_count || gen->steppers[stepper].config.formula)
        return STEP_BAD_CONFIG;
    for (int i = 0; i < AXES; i++)
        if (!(fabs(weights[i]) < LONGEST_S))
            return STEP_BAD_CONFIG;
    if (gen->surface.grid.points_x && moves_z_and_e(weights))
        return STEP_BAD_CONFIG;
    if (!may_change(gen))
        return STEP_NOT_IDLE;
    struct stepper *s = &gen->steppers[stepper];
    start_afresh(gen);
    const double before = step_absolute(gen, s, gen->rest);
    memcpy(s->config.weights, weights, sizeof(s->config.weights));
    s->origin += step_absolute(gen, s, gen->rest) - before;
    start_afresh(gen);
    return STEP_OK;
}

int step_set_smooth_time(struct step_gen *gen, int stepper, double smooth_s) {
    const bool is_window = smooth_s >= STEP_SMOOTH_MIN_US / 1e6 && smooth_s <= STEP_SMOOTH_MAX_US / 1e6;
    if (stepper < 0 || stepper >= gen->stepper_count || !(smooth_s == 0 || is_window))
        return STEP_BAD_CONFIG;
    if (!may_change(gen))
        return STEP_NOT_IDLE;
    gen->steppers[stepper].smooth_s = smooth_s;
    start_afresh(gen);
    return STEP_OK;
}

int step_set_surface(struct step_gen *gen, const struct step_surface *grid, double *z) {
    if (!step_surface_is_legal(grid) || (grid->points_x && !grid->patches))
        return STEP_BAD_CONFIG;
    for (const struct stepper *s = gen->steppers; grid->points_x && s < gen->steppers + gen->stepper_count;
         s++)
        if (!s->config.formula && moves_z_and_e(s->config.weights))
            return STEP_BAD_CONFIG;
    if (!may_change(gen))
        return STEP_NOT_IDLE;
    start_afresh(gen);
    double at[AXES];
    memcpy(at, gen->rest, sizeof(at));
    at[AXIS_Z] = step_surface_motor_z(&gen->surface.grid, at[AXIS_X], at[AXIS_Y], at[AXIS_Z]);
    step_surface_set(&gen->surface, grid);
    gen->rest[AXIS_Z] = step_surface_planned_z(&gen->surface.grid, at[AXIS_X], at[AXIS_Y], at[AXIS_Z]);
    start_afresh(gen);
    planned_position(gen, at);
    step_table_stand(&gen->tables[AXIS_Z], at[AXIS_Z], gen->tables[AXIS_Z].offset);
    *z = at[AXIS_Z];
    return STEP_OK;
}

double step_look_ahead(const struct step_gen *gen) {
    double most = 0;
    for (int i = 0; i < gen->stepper_count; i++)
        most = fmax(most, gen->steppers[i].reach);
    return most;
}

double step_lag(const struct step_gen *gen) {
    double most = 0;
    for (int i = 0; i < gen->stepper_count; i++)
        most = fmax(most, gen->steppers[i].lag);
    return most;
}
