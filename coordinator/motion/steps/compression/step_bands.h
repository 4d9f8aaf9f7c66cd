// SPDX-License-Identifier: Apache-2.0
// The bands that steps must keep, and the check that what is sent to a node keeps them, whoever made it.
#ifndef MOTION_STEP_BANDS_H
#define MOTION_STEP_BANDS_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

// Steps due at TICKS (COUNT > 0, ascending), and the ones before and behind them, which may be far away.
struct step_bands {
    const double *ticks;
    size_t count;
    double before, next;
    double max_error; // ticks to either side, unless half the distance to the nearer neighbour is less
    double *low, *high;
};

// Fills LOW and HIGH; returns the smallest distance between two steps of TICKS (not to those around them).
double step_bands(const struct step_bands *b);

// A queue_step as it goes to the node, and the steps that it is to do. Times in ticks from any one base.
struct replay {
    int64_t clock; // of the step before
    uint32_t interval;
    uint16_t count; // > 0
    int16_t add;
    int64_t shortest, finish;         // interval, and the clock the last step shall have
    const double *ticks, *low, *high; // due times and their bands
};

// Does the steps as the node will. Returns whether each comes within its band, not too soon after the one
// before, and the last when it shall; and the largest distance from a due time.
bool step_replay(const struct replay *r, double *worst);

#endif
