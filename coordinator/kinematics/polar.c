// SPDX-License-Identifier: Apache-2.0
// Polar: a turning bed and an arm over its middle.
#include "coordinator/motion/steps/times/step_formula.h"

static const double TURN = 6.283185307179586476925286766559;

static double radius(const double *q, double near, const double *p, const double *v, double *speed) {
    (void)q;
    (void)near;
    const double out = sqrt(p[AXIS_X] * p[AXIS_X] + p[AXIS_Y] * p[AXIS_Y]);
    *speed = out > 0 ? (p[AXIS_X] * v[AXIS_X] + p[AXIS_Y] * v[AXIS_Y]) / out : 0;
    return out;
}

STEP_FORMULA(polar_radius, .axes = STEP_USES_X | STEP_USES_Y, .position = radius);

// Of all turns the one next to NEAR; in the middle NEAR itself.
static double angle(const double *q, double near, const double *p, const double *v, double *speed) {
    (void)q;
    const double square = p[AXIS_X] * p[AXIS_X] + p[AXIS_Y] * p[AXIS_Y];
    const double turned = square > 0 ? atan2(p[AXIS_Y], p[AXIS_X]) : near;
    *speed = square > 0 ? (p[AXIS_X] * v[AXIS_Y] - p[AXIS_Y] * v[AXIS_X]) / square : 0;
    return turned + TURN * nearbyint((near - turned) / TURN);
}

STEP_FORMULA(polar_angle, .axes = STEP_USES_X | STEP_USES_Y, .unwraps = true, .position = angle);
