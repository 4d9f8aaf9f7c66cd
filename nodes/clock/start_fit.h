// SPDX-License-Identifier: Apache-2.0
// The arithmetic of start.py, which explains the method: the belief about a starting clock, given all bounds.
#ifndef START_FIT_H
#define START_FIT_H

#include <stdint.h>

// cffi: begin
enum {
    START_SAMPLES = 64,
    START_STATES = 4, // lead (s), rate, curvature (1/s) at time 0, and fastest delay (s)
    START_WAYS = 2,   // out and back: lead + delay <= bound_s[0], delay - lead <= bound_s[1], at time AT_S
};

struct start_exchange {
    double at_s;
    double bound_s[START_WAYS];
    // Of the Gaussian factors that replace the bounds; shift is precision times mean. Zero: no factor yet.
    double precision[START_WAYS];
    double shift[START_WAYS];
};

struct start_fit {
    // Precision, and precision times mean, of the states before any exchange.
    double prior[START_STATES];
    double pull[START_STATES];
    // The belief given the factors.
    double mean[START_STATES];
    double covariance[START_STATES][START_STATES];
    uint32_t count;
    struct start_exchange exchanges[START_SAMPLES];
};

// Sets mean and covariance from the prior and the factors.
void start_fit_solve(struct start_fit *fit);

// Returns the sum of the distances of the mean from the bounds, each from 0 to MOST_S.
double start_fit_gaps(const struct start_fit *fit, double most_s);

// Moves every factor by the share DAMPING towards the one that gives the belief from all others the mean and
// variance that the bound would give it. SPREAD_S: mean excess over the fastest delay; NOISE_S: noise of
// readings; LOOSE_S: bounds further off than this give no pull towards them.
void start_fit_sweep(struct start_fit *fit, double spread_s, double noise_s, double loose_s, double damping);
// cffi: end

#endif
