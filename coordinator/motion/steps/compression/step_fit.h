// SPDX-License-Identifier: Apache-2.0
// Which segments can follow a clock.
//
// A segment (interval, add) does step n at clock + interval·n + add·n(n−1)/2. Divided by n, step n asks that
// the straight line interval + add·h, h = (n−1)/2, passes through the gate
//   [(low − clock)/n, (high − clock)/n]   at h.
// A line passes through all gates exactly when its slope is not above (highᵢ − lowⱼ)/(hᵢ − hⱼ) and not below
// (lowᵢ − highⱼ)/(hᵢ − hⱼ) for every pair j < i (Helly's theorem for segments on parallel lines).
//
// A dozen gates, evenly spread, are looked at first: what no line passes even so cannot be done. A segment
// that passes them is checked step by step; where a step is not in its band, its gate is looked at too, and
// so on until the segment is right or there is none. So it is decided exactly, at the price of a few gates.
#ifndef MOTION_STEP_FIT_H
#define MOTION_STEP_FIT_H

#include <stdbool.h>
#include <stdint.h>

enum {
    FIT_ENDS = 3,          // where in its band a segment may end: below, about and above the true time
    FIT_COUNT_MAX = 65535, // as the wire has it
    FIT_ADD_MAX = 32767,
    FIT_GATES = 24,
    FIT_EXTRA = 4, // gates looked at because a segment missed them
    FIT_LANES = 8,
};

// Steps to follow CLOCK, the clock of the step before them. Times in ticks, arrays of COUNT.
struct fit_problem {
    const double *ticks, *low, *high; // due times and their bands
    uint32_t count;
    uint32_t most;     // that a segment may have, up to FIT_COUNT_MAX
    uint32_t expected; // about how many steps a segment will reach: how finely to look
    double clock;      // whole ticks
    double shortest;   // interval
};

struct fit_segment {
    uint32_t count;       // 0: none
    double interval, add; // whole numbers
};

// What was found for a problem. Segments end at places, every STRIDE steps; gates stand at every SPACING-th.
struct fit {
    uint32_t count[FIT_ENDS]; // about how many steps the longest segment with each end has; 0: there is none
    struct fit_adds {
        float least, most;
    } adds[FIT_ENDS];     // of lines to there, whole, measured from ADD
    bool open;            // a segment might reach beyond the steps there are
    double interval, add; // from where lines are measured: whole numbers, near all that pass
    int32_t stride, spacing, gates, extra;
    float low[FIT_GATES + FIT_LANES], high[FIT_GATES + FIT_LANES];
    float least[FIT_GATES + FIT_LANES], most[FIT_GATES + FIT_LANES]; // slopes that pass so many gates
    float extra_place[FIT_EXTRA], extra_low[FIT_EXTRA], extra_high[FIT_EXTRA];
};

// Finds how far a segment reaches for each end.
void step_fit_find(const struct fit_problem *p, struct fit *f);

// Makes the longest segment with END of which every step is in its band, and no interval too short. Reaches
// on to the last step of the problem when that is near. Returns false when there is not even a single step.
bool step_fit_make(const struct fit_problem *p, struct fit *f, int end, struct fit_segment *s);

#endif
