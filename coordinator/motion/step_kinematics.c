// SPDX-License-Identifier: Apache-2.0
// Position and speed of steppers that are not linear, from position and velocity of the axes.
#include "coordinator/motion/step_internal.h"

static const double TURN = 6.283185307179586476925286766559;

// √(arm² − …): the height of a carriage above the head.
static double carriage(double arm2, const double *far, const double *p, const double *v, int n,
                       double *speed) {
    double rest = arm2, change = 0;
    for (int i = 0; i < n; i++) {
        rest -= (far[i] - p[i]) * (far[i] - p[i]);
        change += (far[i] - p[i]) * v[i];
    }
    const double height = sqrt(rest);
    *speed = v[AXIS_Z] + change / height;
    return p[AXIS_Z] + height;
}

static double distance(const double *from, const double *p, const double *v, int n, double *speed) {
    double square = 0, change = 0;
    for (int i = 0; i < n; i++) {
        square += (p[i] - from[i]) * (p[i] - from[i]);
        change += (p[i] - from[i]) * v[i];
    }
    const double length = sqrt(square);
    *speed = length > 0 ? change / length : 0;
    return length;
}

static double polar_angle(double near, const double *p, const double *v, double *speed) {
    const double square = p[0] * p[0] + p[1] * p[1];
    const double angle = square > 0 ? atan2(p[1], p[0]) : near;
    *speed = square > 0 ? (p[0] * v[1] - p[1] * v[0]) / square : 0;
    return angle + TURN * nearbyint((near - angle) / TURN);
}

// Params: upper arm U, lower arm L, shoulder's radius R and height H, cosine and sine of its direction. The
// elbow (R + U·cos θ, H + U·sin θ) is L away from the head; the speed is that equation's derivative.
static double rotary_delta(const double *q, const double *p, const double *v, double *speed) {
    const double out = q[4] * p[0] + q[5] * p[1], beside = q[4] * p[1] - q[5] * p[0];
    const double out_v = q[4] * v[0] + q[5] * v[1], beside_v = q[4] * v[1] - q[5] * v[0];
    const double a = q[2] - out, b = q[3] - p[2], square = a * a + b * b;
    const double k = (q[1] * q[1] - beside * beside - q[0] * q[0] - square) / (2 * q[0]);
    const double angle = atan2(b, a) - acos(k / sqrt(square));
    const double x = a + q[0] * cos(angle), z = b + q[0] * sin(angle);
    *speed = (x * out_v + z * v[2] - beside * beside_v) / (q[0] * (z * cos(angle) - x * sin(angle)));
    return angle;
}

double step_kinematic(const struct step_stepper_config *config, double angle, const double *p,
                      const double *v, double *speed) {
    static const double middle[2] = {0, 0};
    const double *q = config->params;
    switch ((enum step_kinematics)config->kinematics) {
    case STEP_DELTA:
        return carriage(q[0], q + 1, p, v, 2, speed);
    case STEP_DELTESIAN:
        return carriage(q[0], q + 1, p, v, 1, speed);
    case STEP_POLAR_RADIUS:
        return distance(middle, p, v, 2, speed);
    case STEP_POLAR_ANGLE:
        return polar_angle(angle, p, v, speed);
    case STEP_ROTARY_DELTA:
        return rotary_delta(q, p, v, speed);
    case STEP_WINCH:
        return distance(q, p, v, 3, speed);
    case STEP_LINEAR:
    case STEP_KINEMATICS:
        break;
    }
    *speed = 0;
    return NAN;
}
