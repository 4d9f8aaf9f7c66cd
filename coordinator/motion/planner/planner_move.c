// SPDX-License-Identifier: Apache-2.0
// One move by itself: where it may go, and how fast.
#include "coordinator/motion/planner/planner_internal.h"
#include <math.h>

static const double MIN_LENGTH = 1e-9;   // mm
static const double POSITION_EPS = 1e-9; // mm by which sums of relative moves may miss a limit
static const double MAX_EXTRUSION = 1e9; // mm; also keeps infinity and NaN out
static const double MIN_SPEED = 1e-4;    // mm/s; keeps every duration finite
static const double FASTEST = 1e9;       // mm/s; keeps the reported figures of any speed finite
// A move that extrudes no more than this length of path may hold is never refused: slicers round.
static const double TINY_PATH = 0.1; // mm

int planner_refuse(struct planner *p, int32_t kind, int32_t axis, double value, double low, double high) {
    p->fault = (struct planner_fault){.kind = kind, .axis = axis, .value = value, .low = low, .high = high};
    return -1;
}

static void limit(struct planned_move *move, double ratio, double velocity, double accel) {
    if (ratio <= 0)
        return;
    double speed = velocity / ratio;
    move->cruise_v2 = min_of(move->cruise_v2, speed * speed);
    move->accel = min_of(move->accel, accel / ratio);
}

// As limit; 0 stands for no limit.
static void limit_axis(struct planned_move *move, double ratio, double velocity, double accel) {
    if (velocity > 0 || accel > 0)
        limit(move, fabs(ratio), velocity > 0 ? velocity : INFINITY, accel > 0 ? accel : INFINITY);
}

// How far Z stays below the top of the cone.
static double below_cone(const struct planner_limits *l, const double at[4]) {
    double down_x = l->cone_slope[0] * at[AXIS_X], down_y = l->cone_slope[1] * at[AXIS_Y];
    return l->cone_top - sqrt(down_x * down_x + down_y * down_y) - at[AXIS_Z];
}

// Above the box Z stays within the cone; the way between a point of the box outside of the cone and one above
// the box need not lie in either.
static int check_cone(struct planner *p, const double target[4]) {
    const struct planner_limits *l = &p->limits;
    double box_top = l->position_max[AXIS_Z] + POSITION_EPS;
    int from_above = p->position[AXIS_Z] > box_top, to_above = target[AXIS_Z] > box_top;
    if (!from_above && !to_above)
        return 0;
    double room = below_cone(l, target);
    if (room >= -POSITION_EPS && (from_above || below_cone(l, p->position) >= -POSITION_EPS))
        return 0;
    double high = room >= -POSITION_EPS ? l->position_max[AXIS_Z] : target[AXIS_Z] + room;
    return planner_refuse(p, PLANNER_OUTSIDE, AXIS_Z, target[AXIS_Z], l->position_min[AXIS_Z], high);
}

// Where moves end, and where they pass by the Z axis: the disc is convex, its hole is not.
static int check_radius(struct planner *p, const double delta[4], const double target[4]) {
    double high = p->limits.max_radius, low = p->limits.radius_min;
    if (delta[AXIS_X] == 0 && delta[AXIS_Y] == 0)
        return 0;
    double radius = sqrt(target[0] * target[0] + target[1] * target[1]);
    if (high > 0 && !(radius <= high + POSITION_EPS))
        return planner_refuse(p, PLANNER_TOO_FAR, AXIS_X, radius, low, high);
    if (low <= 0)
        return 0;
    double way2 = delta[0] * delta[0] + delta[1] * delta[1];
    double back = (target[0] * delta[0] + target[1] * delta[1]) / way2; // share of the way behind the foot
    back = min_of(max_of(back, 0), 1);
    double x = target[0] - back * delta[0], y = target[1] - back * delta[1];
    double nearest = sqrt(x * x + y * y);
    if (!(nearest >= low - POSITION_EPS))
        return planner_refuse(p, PLANNER_TOO_NEAR, AXIS_X, nearest, low, high);
    return 0;
}

static int check_range(struct planner *p, const double delta[4], const double target[4]) {
    int has_cone = p->limits.cone_slope[0] > 0 || p->limits.cone_slope[1] > 0;
    for (int axis = 0; axis < 3; axis++) {
        if (delta[axis] == 0)
            continue;
        double low = p->limits.position_min[axis], high = p->limits.position_max[axis];
        if (has_cone && axis == AXIS_Z)
            high = max_of(high, p->limits.cone_top);
        if (!(p->homed >> axis & 1))
            return planner_refuse(p, PLANNER_NOT_HOMED, axis, target[axis], low, high);
        if (!(target[axis] >= low - POSITION_EPS && target[axis] <= high + POSITION_EPS))
            return planner_refuse(p, PLANNER_OUTSIDE, axis, target[axis], low, high);
    }
    if ((p->limits.max_radius > 0 || p->limits.radius_min > 0) && check_radius(p, delta, target))
        return -1;
    return has_cone ? check_cone(p, target) : 0;
}

// How much faster than the head a carriage of a delta may be.
static const double TOWER_SPEED = 3;

// A carriage is h / √(rod² − h²) times as fast as the head where its rod reaches h far level. Out where that
// is more than TOWER_SPEED the move is slower by as much, speed and acceleration; the disc is convex, so no
// part of a move is further out than its ends.
static void limit_towers(const struct planner *p, struct planned_move *move, const double target[4]) {
    const struct planner_limits *l = &p->limits;
    double from = sqrt(p->position[0] * p->position[0] + p->position[1] * p->position[1]);
    double to = sqrt(target[0] * target[0] + target[1] * target[1]);
    double level = l->tower_radius + max_of(from, to);
    double upright2 = l->tower_rod * l->tower_rod - level * level;
    double steepest2 = level * level / (TOWER_SPEED * TOWER_SPEED);
    if (upright2 >= steepest2)
        return;
    double slower = sqrt(steepest2 / max_of(upright2, 1e-6 * steepest2));
    limit(move, slower, l->max_velocity, l->max_accel);
}

// Limits of a move along X Y Z that may print, from its ratios.
static int check_path(struct planner *p, struct planned_move *move, const double target[4], double delta_e) {
    const struct planner_limits *l = &p->limits;
    double ratio = move->ratio[AXIS_E];
    limit_axis(move, move->ratio[AXIS_X], l->max_x_velocity, l->max_x_accel);
    limit_axis(move, move->ratio[AXIS_Y], l->max_y_velocity, l->max_y_accel);
    limit(move, fabs(move->ratio[AXIS_Z]), l->max_z_velocity, l->max_z_accel);
    if (l->tower_rod > 0)
        limit_towers(p, move, target);
    if (ratio < 0 && !(-delta_e <= l->max_extrude_only_distance))
        return planner_refuse(p, PLANNER_EXTRUDE_LONG, AXIS_E, -delta_e, 0, l->max_extrude_only_distance);
    if (ratio > l->max_extrude_ratio && delta_e > l->max_extrude_ratio * TINY_PATH)
        return planner_refuse(p, PLANNER_EXTRUDE_RATIO, AXIS_E, ratio, 0, l->max_extrude_ratio);
    if (ratio < 0 || ratio > l->max_extrude_ratio)
        limit(move, fabs(ratio), l->max_extrude_only_velocity, l->max_extrude_only_accel);
    return 0;
}

static int check_extrude_only(struct planner *p, struct planned_move *move) {
    const struct planner_limits *l = &p->limits;
    if (!(move->length <= l->max_extrude_only_distance))
        return planner_refuse(p, PLANNER_EXTRUDE_LONG, AXIS_E, move->length, 0, l->max_extrude_only_distance);
    limit(move, 1, l->max_extrude_only_velocity, l->max_extrude_only_accel);
    return 0;
}

// The limit that bounds MOVE; the same figures as check_path and check_extrude_only used.
static enum planner_speed_limit binding_limit(const struct planner_limits *l,
                                              const struct planned_move *move) {
    const double *ratio = move->ratio;
    const double filament = fabs(ratio[AXIS_E]);
    const int e_counts = move->extrude_only || ratio[AXIS_E] < 0 || filament > l->max_extrude_ratio;
    const double per_mm[PLANNER_SPEED_LIMITS] = {1, fabs(ratio[AXIS_X]), fabs(ratio[AXIS_Y]),
                                                 fabs(ratio[AXIS_Z]), e_counts ? filament : 0};
    const double most[PLANNER_SPEED_LIMITS] = {l->max_velocity, l->max_x_velocity, l->max_y_velocity,
                                               l->max_z_velocity, l->max_extrude_only_velocity};
    enum planner_speed_limit lowest = PLANNER_LIMIT_PATH;
    for (int i = 1; i < PLANNER_SPEED_LIMITS; i++)
        if (most[i] > 0 && per_mm[i] * most[lowest] > most[i] * per_mm[lowest])
            lowest = (enum planner_speed_limit)i;
    return lowest;
}

void planner_note_slowed(struct planner *p, const struct planned_move *move, double speed) {
    const double rounding = 1 + 1e-9;
    if (speed * speed <= move->cruise_v2 * rounding)
        return;
    struct planner_slowed *slowed = &p->slowed[binding_limit(&p->limits, move)];
    const double allowed = sqrt(move->cruise_v2);
    if (!slowed->moves++)
        slowed->first_line = p->line;
    if (slowed->moves == 1 || speed * slowed->allowed > slowed->asked * allowed) {
        slowed->worst_line = p->line;
        slowed->asked = min_of(speed, FASTEST);
        slowed->allowed = allowed;
    }
}

int planner_describe(struct planner *p, struct planned_move *move, const double target[4], double speed) {
    double delta[4];
    for (int axis = 0; axis < 4; axis++)
        delta[axis] = target[axis] - p->position[axis];
    if (check_range(p, delta, target))
        return -1;
    if (!(fabs(delta[AXIS_E]) <= MAX_EXTRUSION))
        return planner_refuse(p, PLANNER_EXTRUDE_LONG, AXIS_E, delta[AXIS_E], 0,
                              p->limits.max_extrude_only_distance);
    if (p->cold && fabs(delta[AXIS_E]) >= MIN_LENGTH)
        return planner_refuse(p, PLANNER_COLD, AXIS_E, delta[AXIS_E], 0, 0);
    if (!(speed >= MIN_SPEED))
        return planner_refuse(p, PLANNER_SPEED, 0, speed, MIN_SPEED, INFINITY);

    double length = sqrt(delta[0] * delta[0] + delta[1] * delta[1] + delta[2] * delta[2]);
    move->extrude_only = length < MIN_LENGTH;
    if (move->extrude_only) {
        delta[0] = delta[1] = delta[2] = 0;
        length = fabs(delta[AXIS_E]);
        if (length < MIN_LENGTH)
            return 0;
    }
    double scale = 1 / length;
    for (int axis = 0; axis < 4; axis++) {
        move->start[axis] = p->position[axis];
        move->ratio[axis] = delta[axis] * scale;
    }
    move->length = length;
    move->accel = planner_asked_accel(p, move);
    move->cruise_v2 = p->limits.max_velocity * p->limits.max_velocity;
    if (speed < p->limits.max_velocity)
        move->cruise_v2 = speed * speed;
    if (move->extrude_only ? check_extrude_only(p, move) : check_path(p, move, target, delta[AXIS_E]))
        return -1;
    return 1;
}
