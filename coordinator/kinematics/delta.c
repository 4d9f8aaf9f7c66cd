// SPDX-License-Identifier: Apache-2.0
// Linear delta: a carriage on a vertical tower, an arm from it to the head. Params: arm², tower x, tower y.
#include "coordinator/motion/steps/step_internal.h"

double kin_delta(const double *q, const double *p, const double *v, double *speed) {
    const double dx = q[1] - p[AXIS_X], dy = q[2] - p[AXIS_Y];
    const double rise = sqrt(q[0] - dx * dx - dy * dy);
    *speed = v[AXIS_Z] + (dx * v[AXIS_X] + dy * v[AXIS_Y]) / rise;
    return p[AXIS_Z] + rise;
}
