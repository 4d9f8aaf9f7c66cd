// SPDX-License-Identifier: Apache-2.0
// How far a move goes and when it ends.
#ifndef MOTION_MOVE_WAY_H
#define MOTION_MOVE_WAY_H

#include "coordinator/motion/trapezoid.h"

static inline double move_end_s(const struct trapezoid *m) {
    return m->print_time + m->accel_s + m->cruise_s + m->decel_s;
}

// The way along the whole move, mm.
static inline double move_way_mm(const struct trapezoid *m) {
    return m->start_v * m->accel_s + m->accel * m->accel_s * m->accel_s / 2 +
           m->cruise_v * (m->cruise_s + m->decel_s) - m->accel * m->decel_s * m->decel_s / 2;
}

#endif
