// SPDX-License-Identifier: Apache-2.0
// Between the parts of the look-ahead.
#ifndef MOTION_PLANNER_INTERNAL_H
#define MOTION_PLANNER_INTERNAL_H

#include "coordinator/motion/planner/planner_queue.h"

static inline double min_of(double a, double b) {
    return a < b ? a : b;
}

static inline double max_of(double a, double b) {
    return a > b ? a : b;
}

// mm/s² that is asked for MOVE.
static inline double planner_asked_accel(const struct planner *p, const struct planned_move *move) {
    return move->ratio[AXIS_E] != 0 ? p->accel : p->travel_accel;
}

// Notes why a move is refused; returns -1.
int planner_refuse(struct planner *p, int32_t kind, int32_t axis, double value, double low, double high);

// Counts MOVE, which asked for SPEED, when a limit allows less.
void planner_note_slowed(struct planner *p, const struct planned_move *move, double speed);

// Fills what MOVE is by itself: start, ratio, length, accel, cruise_v2, extrude_only. Returns 1 when it is to
// be added, 0 when it is too short, -1 when it is refused.
int planner_describe(struct planner *p, struct planned_move *move, const double target[4], double speed);

#endif
