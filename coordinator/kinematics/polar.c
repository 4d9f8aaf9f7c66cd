// SPDX-License-Identifier: Apache-2.0
// Polar: a turning bed and an arm over its middle.
#include "coordinator/motion/steps/step_internal.h"

static const double TURN = 6.283185307179586476925286766559;

double kin_polar_radius(const double *p, const double *v, double *speed) {
    const double radius = sqrt(p[AXIS_X] * p[AXIS_X] + p[AXIS_Y] * p[AXIS_Y]);
    *speed = radius > 0 ? (p[AXIS_X] * v[AXIS_X] + p[AXIS_Y] * v[AXIS_Y]) / radius : 0;
    return radius;
}

// Of all turns the one next to NEAR; in the middle NEAR itself.
double kin_polar_angle(double near, const double *p, const double *v, double *speed) {
    const double square = p[AXIS_X] * p[AXIS_X] + p[AXIS_Y] * p[AXIS_Y];
    const double angle = square > 0 ? atan2(p[AXIS_Y], p[AXIS_X]) : near;
    *speed = square > 0 ? (p[AXIS_X] * v[AXIS_Y] - p[AXIS_Y] * v[AXIS_X]) / square : 0;
    return angle + TURN * nearbyint((near - angle) / TURN);
}
