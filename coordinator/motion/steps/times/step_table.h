// SPDX-License-Identifier: Apache-2.0
// Between planner and step generation: each axis's correction is added to its planned motion.
//
// Between two points of a table the corrected position of an axis is linear in the planned one. So a move is
// cut where an axis passes a point, and each piece stays a trapezoid, with another ratio of that axis: step
// times stay exact, and shapers, pressure advance and all steppers that carry the axis need not know.
//
// The side follows the way the axis goes: it changes when the axis is STEP_TABLE_TURN_MM behind the furthest
// place it has been at, there and then, whatever the length of the moves. What the correction jumps by, then
// or when a table is set, is LAG: it fades along the moves that follow, at the table's take-up speed at the
// most and never faster than 1 mm per mm of way. Nothing moves by itself: at standstill no step is made.
#ifndef MOTION_STEP_TABLE_H
#define MOTION_STEP_TABLE_H

#include "coordinator/motion/steps/steps.h"

#include <stdbool.h>

struct axis_table {
    int n;                  // points; 0: none
    const double *position; // mm, ascending
    const double *side[2];  // mm, to be added: forward, reverse
    double take_up;         // mm/s
    int reverse;            // which side is in use
    double turn;            // mm: the furthest the axis has been at on this side
    double lag;             // mm: how far its motor is beyond where the table wants it
    double offset;          // mm: all that is added at the end of the last move that was appended
};

// Whether moves have to go through step_table_cut.
bool step_table_acts(const struct axis_table tables[3]);

// No more pieces come of a move.
int step_table_most_pieces(const struct axis_table tables[3], const struct trapezoid *move);

// Cuts a legal MOVE into corrected pieces, which TAKE gets in order.
void step_table_cut(struct axis_table tables[3], const struct trapezoid *move,
                    void (*take)(void *context, const struct trapezoid *piece), void *context);

// The axis stands at POSITION, its motor OFFSET beyond: the lag is what the table wants otherwise.
void step_table_stand(struct axis_table *table, double position, double offset);

#endif
