// SPDX-License-Identifier: Apache-2.0
// Which segments can follow a clock: decided exactly over the steps that are looked at.
//
// A segment (interval, add) does step n at clock + interval·n + add·n(n−1)/2. Divided by n, step n asks that
// the straight line interval + add·h, h = (n−1)/2, passes through the gate
//   [(low − clock)/n, (high − clock)/n]   at h.
// A line passes through all gates exactly when its slope is not above (highᵢ − lowⱼ)/(hᵢ − hⱼ) and not below
// (lowᵢ − highⱼ)/(hᵢ − hⱼ) for every pair j < i (Helly's theorem for segments on parallel lines). So the
// range of adds, running over more and more gates, says how far any segment reaches.
#ifndef MOTION_STEP_FIT_H
#define MOTION_STEP_FIT_H

#include <stdbool.h>
#include <stdint.h>

// Where in its band a segment may end: below, about and above the true time.
enum { FIT_ENDS = 3, FIT_COUNT_MAX = 65535, FIT_ADD_MAX = 32767 };

// Steps to follow CLOCK, the clock of the step before them. Times in ticks, arrays of COUNT.
struct fit_problem {
    const double *ticks, *low, *high; // due times and their bands
    uint32_t count;
    uint32_t expected; // about how many steps a segment will reach: how finely to look
    double clock;      // whole ticks
    double shortest;   // interval
};

struct fit_segment {
    uint32_t count;       // 0: none
    double interval, add; // whole numbers
};

struct fit {
    struct fit_segment end[FIT_ENDS]; // the longest with this end
    bool open;                        // a segment might reach beyond the steps there are
};

// Finds the longest segment for each end. At most 64 to 128 steps are looked at, evenly spread: what lies
// between must be checked. Without any, end[1] is the single next step; without that, nothing.
void step_fit(const struct fit_problem *p, struct fit *out);

// Checks every step of a segment, exactly; shortens it to those that are right, or to the single next step
// when the first is not; lengthens it when it nearly reaches the last step. Returns false when there is not
// even a single step.
bool step_fit_check(const struct fit_problem *p, struct fit_segment *s);

#endif
