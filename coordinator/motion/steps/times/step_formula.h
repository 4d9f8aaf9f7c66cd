// SPDX-License-Identifier: Apache-2.0
// How a stepper follows the head where its position is no sum of axes: one formula per kind of rail.
//
// A formula stands in coordinator/kinematics/NAME.c and registers itself by STEP_FORMULA: the linker gathers
// what is in the section step_formulas of all files into one table. Python names it in a StepFunction.
#ifndef MOTION_STEP_FORMULA_H
#define MOTION_STEP_FORMULA_H

#include "coordinator/motion/trapezoid.h"

#include <math.h>
#include <stdbool.h>

enum { STEP_USES_X = 1 << AXIS_X, STEP_USES_Y = 1 << AXIS_Y, STEP_USES_Z = 1 << AXIS_Z };

struct step_formula {
    const char *name;
    unsigned axes; // STEP_USES_...: those that move the stepper
    bool unwraps;  // an angle of any number of turns: of all turns it is the one nearest to NEAR
    // Position (mm or rad) for the stepper's parameters Q and the axes' positions P, and its SPEED for their
    // speeds V; NAN where the head cannot be. NEAR: a position close by.
    double (*position)(const double *q, double near, const double *p, const double *v, double *speed);
};

// STEP_FORMULA(delta, .axes = ..., .position = ...) defines formula_delta, known as "delta".
#define STEP_FORMULA(NAME, ...)                                                                              \
    extern const struct step_formula formula_##NAME;                                                         \
    const struct step_formula formula_##NAME = {.name = #NAME, __VA_ARGS__};                                 \
    __attribute__((used, section("step_formulas"))) static const struct step_formula *const entry_##NAME =   \
        &formula_##NAME

#endif
