// SPDX-License-Identifier: Apache-2.0
// What steps.c and step_change.c share: ranges, and what follows from a setting.
#ifndef MOTION_STEP_CHANGE_H
#define MOTION_STEP_CHANGE_H

#include "coordinator/motion/steps/step_internal.h"

#define LONGEST_S 1e9   // any time or duration; also any place or share
#define FASTEST_HZ 1e10 // any clock

static inline bool step_in_range(double value, double low, double high) {
    return value > low && value <= high; // false for NaN
}

// The stepper's position at POSITION, in steps, not counted from its origin.
double step_absolute(const struct step_gen *gen, struct stepper *stepper, const double *position);

// What depends on how fast the stepper's node counts.
void step_set_tick_limits(struct stepper *stepper, double max_error_s);

// What is done up to the border took no other move into account: none may begin so early that it acts there.
void step_assume_rest(struct step_gen *gen);

#endif
