// SPDX-License-Identifier: Apache-2.0
// Winch: a cable from its anchor to the head. Params: the anchor x, y, z.
#include "coordinator/motion/steps/times/step_formula.h"

static double position(const double *q, double near, const double *p, const double *v, double *speed) {
    (void)near;
    double square = 0, change = 0;
    for (int i = 0; i < 3; i++) {
        square += (p[i] - q[i]) * (p[i] - q[i]);
        change += (p[i] - q[i]) * v[i];
    }
    const double length = sqrt(square);
    *speed = length > 0 ? change / length : 0;
    return length;
}

STEP_FORMULA(winch, .axes = STEP_USES_X | STEP_USES_Y | STEP_USES_Z, .position = position);
