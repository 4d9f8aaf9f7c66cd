// SPDX-License-Identifier: Apache-2.0
// What straight moves and arcs have in common.
#ifndef MOTION_GCODE_INTERNAL_H
#define MOTION_GCODE_INTERNAL_H

#include "coordinator/motion/planner/gcode_lines.h"

// The speed of a move with these words, mm/s, before the speed factor.
double gcode_speed(const struct gcode_state *state, const struct gcode_words *words);

// Where a move with these words leads to, mm in the machine's frame.
void gcode_target(const struct gcode_state *state, const struct gcode_words *words, double target[4]);

// Moves to TARGET, or only takes it as the place where the program is while it is excluded. Returns 0, or -1
// as planner_add.
int gcode_go(struct gcode_state *state, struct planner *planner, const double target[4], double speed);

#endif
