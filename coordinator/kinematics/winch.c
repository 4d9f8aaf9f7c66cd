// SPDX-License-Identifier: Apache-2.0
// Winch: a cable from its anchor to the head. Params: the anchor x, y, z.
#include "coordinator/motion/steps/step_internal.h"

double kin_winch(const double *q, const double *p, const double *v, double *speed) {
    double square = 0, change = 0;
    for (int i = 0; i < 3; i++) {
        square += (p[i] - q[i]) * (p[i] - q[i]);
        change += (p[i] - q[i]) * v[i];
    }
    const double length = sqrt(square);
    *speed = length > 0 ? change / length : 0;
    return length;
}
