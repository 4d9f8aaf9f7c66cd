// SPDX-License-Identifier: Apache-2.0
// G2 and G3: an arc becomes straight moves that are never further from it than gcode_state.arc_deviation.
#include "coordinator/motion/planner/gcode_internal.h"
#include <math.h>
#include <string.h>

static const double TURN = 6.283185307179586;
static const double SAME_PLACE = 1e-6; // mm: a start and an end so close make a full circle
// The center may be nearer to one end of the arc than to the other by the rounding of its numbers.
static const double UNEQUAL = 0.02, UNEQUAL_SHARE = 0.001, UNEQUAL_MOST = 0.5; // mm, of the radius, mm
static const double MOST_MM = 1e6;
static const double MOST_PIECES = 1 << 20;
static const double WIDEST_PIECE = 0.7853981633974483; // rad: however small a circle, it has eight corners

// The plane's axes, the first of which turns towards the second; and the bits of their center's words.
static const int32_t AXES_OF[][2] = {
    [GCODE_XY] = {AXIS_X, AXIS_Y}, [GCODE_ZX] = {AXIS_Z, AXIS_X}, [GCODE_YZ] = {AXIS_Y, AXIS_Z}};

// The center, from the offsets I J K or from the radius R; returns an enum gcode_arc_fault.
static int find_center(const struct gcode_state *state, const struct gcode_words *words, int clockwise,
                       struct gcode_arc *arc) {
    uint32_t offsets = 0;
    double way[2], half = 0;
    for (int i = 0; i < 2; i++) {
        int32_t axis = arc->axis[i];
        uint32_t bit = words->given >> (GCODE_I + axis) & 1;
        offsets |= bit;
        arc->center[i] = arc->start[axis] + (bit ? words->value[GCODE_I + axis] * state->unit : 0);
        way[i] = arc->target[axis] - arc->start[axis];
        half += way[i] * way[i] / 4;
    }
    uint32_t by_radius = words->given >> GCODE_R & 1;
    if (by_radius == offsets)
        return GCODE_ARC_NO_CENTER;
    if (!by_radius)
        return GCODE_ARC_FINE;
    // The center lies on the perpendicular of the way: R above 0 is for the arc of at most half a turn.
    double radius = words->value[GCODE_R] * state->unit;
    double beside = radius * radius - half;
    if (!(half > SAME_PLACE * SAME_PLACE) || !(beside >= -UNEQUAL_SHARE * radius * radius))
        return GCODE_ARC_RADIUS;
    double scale = sqrt(fmax(beside, 0) / (4 * half));
    if ((radius > 0) == (clockwise != 0))
        scale = -scale;
    arc->center[0] = arc->start[arc->axis[0]] + way[0] / 2 - scale * way[1];
    arc->center[1] = arc->start[arc->axis[1]] + way[1] / 2 + scale * way[0];
    return GCODE_ARC_FINE;
}

// Angles and radii; returns an enum gcode_arc_fault.
static int measure(struct gcode_arc *arc, int clockwise) {
    double from[2], to[2];
    for (int i = 0; i < 2; i++) {
        from[i] = arc->start[arc->axis[i]] - arc->center[i];
        to[i] = arc->target[arc->axis[i]] - arc->center[i];
    }
    arc->radius = hypot(from[0], from[1]);
    arc->radius_change = hypot(to[0], to[1]) - arc->radius;
    double unequal = fabs(arc->radius_change), share = UNEQUAL_SHARE * arc->radius;
    if (!(arc->radius > SAME_PLACE) || !(unequal <= UNEQUAL || (unequal <= share && unequal <= UNEQUAL_MOST)))
        return GCODE_ARC_UNEQUAL;
    arc->angle = atan2(from[1], from[0]);
    arc->sweep = atan2(from[0] * to[1] - from[1] * to[0], from[0] * to[0] + from[1] * to[1]);
    if (hypot(to[0] - from[0], to[1] - from[1]) < SAME_PLACE)
        arc->sweep = clockwise ? -TURN : TURN;
    else if (clockwise && arc->sweep >= 0)
        arc->sweep -= TURN;
    else if (!clockwise && arc->sweep <= 0)
        arc->sweep += TURN;
    return GCODE_ARC_FINE;
}

// Into how many pieces; 0: too many.
static uint32_t count_pieces(const struct gcode_state *state, const struct gcode_arc *arc) {
    double radius = fmax(arc->radius, arc->radius + arc->radius_change);
    // A chord over the angle a is r·(1 − cos(a/2)) away from its arc.
    double flat = fmax(1 - state->arc_deviation / radius, -1);
    double widest = fmin(2 * acos(flat), WIDEST_PIECE);
    double sweep = fabs(arc->sweep);
    double pieces = ceil(fmax(sweep / widest, sweep * radius / state->arc_piece));
    return pieces <= MOST_PIECES ? (uint32_t)fmax(pieces, 1) : 0;
}

int gcode_arc_begin(struct gcode_state *state, struct planner *planner, const struct gcode_words *words,
                    int clockwise) {
    struct gcode_arc arc = {.axis = {AXES_OF[state->plane][0], AXES_OF[state->plane][1]}};
    memcpy(arc.start, state->position, sizeof arc.start);
    gcode_target(state, words, arc.target);
    arc.speed = gcode_speed(state, words);
    if (arc.speed < 0)
        return GCODE_ARC_SPEED;
    int fault = find_center(state, words, clockwise, &arc);
    if (fault)
        return fault;
    for (int i = 0; i < 2; i++)
        if (!(fabs(arc.center[i]) <= MOST_MM && fabs(arc.target[arc.axis[i]]) <= MOST_MM))
            return GCODE_ARC_HUGE;
    fault = measure(&arc, clockwise);
    if (fault)
        return fault;
    arc.pieces = count_pieces(state, &arc);
    if (!arc.pieces)
        return GCODE_ARC_HUGE;
    if (state->excluded) // then only its end counts, and no full planner interrupts the pieces
        arc.pieces = 1;
    planner->line = (int64_t)state->lines + 1;
    state->speed = arc.speed;
    state->arc = arc;
    return GCODE_ARC_FINE;
}

int gcode_arc_go_on(struct gcode_state *state, struct planner *planner) {
    struct gcode_arc *arc = &state->arc;
    for (; arc->done < arc->pieces; arc->done++) {
        if (!planner_ready(planner))
            return GCODE_FULL;
        uint32_t number = arc->done + 1;
        double target[4], part = (double)number / arc->pieces;
        for (int axis = 0; axis < 4; axis++)
            target[axis] = arc->start[axis] + (arc->target[axis] - arc->start[axis]) * part;
        double radius = arc->radius + arc->radius_change * part, angle = arc->angle + arc->sweep * part;
        target[arc->axis[0]] = arc->center[0] + radius * cos(angle);
        target[arc->axis[1]] = arc->center[1] + radius * sin(angle);
        if (gcode_go(state, planner, number < arc->pieces ? target : arc->target, arc->speed)) {
            arc->pieces = arc->done = 0;
            return GCODE_LIMIT;
        }
    }
    return GCODE_NEED_DATA;
}
