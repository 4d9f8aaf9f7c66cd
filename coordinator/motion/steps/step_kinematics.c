// SPDX-License-Identifier: Apache-2.0
// Position and speed of steppers that are not linear: which formula (kin_*.c) is whose.
#include "coordinator/motion/steps/step_internal.h"

double step_kinematic(const struct step_stepper_config *config, double angle, const double *p,
                      const double *v, double *speed) {
    const double *q = config->params;
    switch ((enum step_kinematics)config->kinematics) {
    case STEP_DELTA:
        return kin_delta(q, p, v, speed);
    case STEP_DELTESIAN:
        return kin_deltesian(q, p, v, speed);
    case STEP_POLAR_RADIUS:
        return kin_polar_radius(p, v, speed);
    case STEP_POLAR_ANGLE:
        return kin_polar_angle(angle, p, v, speed);
    case STEP_ROTARY_DELTA:
        return kin_rotary_delta(q, p, v, speed);
    case STEP_WINCH:
        return kin_winch(q, p, v, speed);
    case STEP_LINEAR:
    case STEP_KINEMATICS:
        break;
    }
    *speed = 0;
    return NAN;
}
