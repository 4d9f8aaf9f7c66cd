// SPDX-License-Identifier: Apache-2.0
// Deltesian: a carriage on a vertical tower in the X Z plane, an arm from it to the head. Params: arm², tower
// x.
#include "coordinator/motion/steps/step_internal.h"

double kin_deltesian(const double *q, const double *p, const double *v, double *speed) {
    const double dx = q[1] - p[AXIS_X];
    const double rise = sqrt(q[0] - dx * dx);
    *speed = v[AXIS_Z] + dx * v[AXIS_X] / rise;
    return p[AXIS_Z] + rise;
}
