// SPDX-License-Identifier: Apache-2.0
// Deltesian: a carriage on a vertical tower in the X Z plane, an arm from it to the head. Params: arm², tower
// x.
#include "coordinator/motion/steps/times/step_formula.h"

static double position(const double *q, double near, const double *p, const double *v, double *speed) {
    (void)near;
    const double dx = q[1] - p[AXIS_X];
    const double rise = sqrt(q[0] - dx * dx);
    *speed = v[AXIS_Z] + dx * v[AXIS_X] / rise;
    return p[AXIS_Z] + rise;
}

STEP_FORMULA(deltesian, .axes = STEP_USES_X | STEP_USES_Z, .position = position);
