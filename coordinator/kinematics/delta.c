// SPDX-License-Identifier: Apache-2.0
// Linear delta: a carriage on a vertical tower, an arm from it to the head. Params: arm², tower x, tower y.
#include "coordinator/motion/steps/times/step_formula.h"

static double position(const double *q, double near, const double *p, const double *v, double *speed) {
    (void)near;
    const double dx = q[1] - p[AXIS_X], dy = q[2] - p[AXIS_Y];
    const double rise = sqrt(q[0] - dx * dx - dy * dy);
    *speed = v[AXIS_Z] + (dx * v[AXIS_X] + dy * v[AXIS_Y]) / rise;
    return p[AXIS_Z] + rise;
}

STEP_FORMULA(delta, .axes = STEP_USES_X | STEP_USES_Y | STEP_USES_Z, .position = position);
