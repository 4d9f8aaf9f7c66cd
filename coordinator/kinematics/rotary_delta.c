// SPDX-License-Identifier: Apache-2.0
// Rotary delta: a shoulder turns the upper arm, the lower one leads from its elbow to the head.
#include "coordinator/motion/steps/times/step_formula.h"

// Params: upper arm U, lower arm L, shoulder's radius R and height H, cosine and sine of its direction. The
// elbow (R + U·cos θ, H + U·sin θ) is L away from the head; the speed is that equation's derivative.
static double position(const double *q, double near, const double *p, const double *v, double *speed) {
    (void)near;
    const double out = q[4] * p[0] + q[5] * p[1], beside = q[4] * p[1] - q[5] * p[0];
    const double out_v = q[4] * v[0] + q[5] * v[1], beside_v = q[4] * v[1] - q[5] * v[0];
    const double a = q[2] - out, b = q[3] - p[2], square = a * a + b * b;
    const double k = (q[1] * q[1] - beside * beside - q[0] * q[0] - square) / (2 * q[0]);
    const double angle = atan2(b, a) - acos(k / sqrt(square));
    const double x = a + q[0] * cos(angle), z = b + q[0] * sin(angle);
    *speed = (x * out_v + z * v[2] - beside * beside_v) / (q[0] * (z * cos(angle) - x * sin(angle)));
    return angle;
}

STEP_FORMULA(rotary_delta, .axes = STEP_USES_X | STEP_USES_Y | STEP_USES_Z, .position = position);
