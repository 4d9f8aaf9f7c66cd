// SPDX-License-Identifier: Apache-2.0
// See pulse_parabola.h: least squares, ROUNDS times, each with the weights that follow from the last.
#include "nodes/clock/pulse_parabola.h"

#include "nodes/clock/linear.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

enum { TERMS = 3, ROUNDS = 4 };
_Static_assert((int)TERMS <= (int)LINEAR_MAX, "linear.h solves for all terms");

// Chosen with simulated ramps of 20 ppm in 600 s: a shorter time follows their start faster, a longer one has
// less noise.
#define FADE_S 8.0
// Least standard deviation of a reading: about the jitter of receive interrupts on an idle chip.
#define JITTER_FLOOR_S 0.3e-6
// Readings further off than so many standard deviations lose weight with the square of that.
#define ROBUST 3.0
// The median deviation of a normal distribution times this is its standard deviation.
#define MEDIAN_TO_SD 1.4826

static int ascending(const void *a, const void *b) {
    double one = *(const double *)a, other = *(const double *)b;
    return (one > other) - (one < other);
}

static double noise_of(const struct pulse_parabola *fit) {
    double ranked_s[PULSE_PAIRS_MAX];
    uint32_t half = fit->count / 2;
    memcpy(ranked_s, fit->off_s, fit->count * sizeof *ranked_s);
    qsort(ranked_s, fit->count, sizeof *ranked_s, ascending);
    double median_s = (ranked_s[half] + ranked_s[fit->count - 1 - half]) / 2;
    return fmax(JITTER_FLOOR_S, MEDIAN_TO_SD * median_s);
}

static void terms(double at_s, double row[TERMS]) {
    row[0] = 1;
    row[1] = at_s;
    row[2] = at_s * at_s / 2;
}

static double dot(const double *a, const double *b) {
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
}

// Solves for the parabola and leaves the FACTORS of the normal equations, which contain HOLD already.
static void solve(struct pulse_parabola *fit, const double *fade, double factors[TERMS][TERMS]) {
    memset(fit->fitted, 0, sizeof fit->fitted);
    for (uint32_t n = 0; n < fit->count; n++) {
        double row[TERMS], far = ROBUST * fit->noise_s / fmax(fit->off_s[n], JITTER_FLOOR_S);
        double weight = fade[n] * fmin(1, far * far) / (fit->noise_s * fit->noise_s);
        terms(fit->at_s[n], row);
        for (int i = 0; i < TERMS; i++) {
            for (int j = 0; j <= i; j++)
                factors[i][j] += weight * row[i] * row[j];
            fit->fitted[i] += weight * row[i] * fit->parted_s[n];
        }
    }
    ldl_factor(TERMS, factors[0]);
    ldl_solve(TERMS, factors[0], fit->fitted);
}

double pulse_parabola_fit(struct pulse_parabola *fit, double rate_sd, double curvature_sd, double ahead_s) {
    const double hold[TERMS] = {0, 1 / (rate_sd * rate_sd), 1 / (curvature_sd * curvature_sd)};
    double fade[PULSE_PAIRS_MAX], factors[TERMS][TERMS];
    for (uint32_t n = 0; n < fit->count; n++)
        fade[n] = exp(fit->at_s[n] / FADE_S);
    fit->noise_s = noise_of(fit);
    for (int round = 0; round < ROUNDS; round++) {
        memset(factors, 0, sizeof factors);
        for (int i = 0; i < TERMS; i++)
            factors[i][i] = hold[i];
        solve(fit, fade, factors);
        for (uint32_t n = 0; n < fit->count; n++) {
            double row[TERMS];
            terms(fit->at_s[n], row);
            fit->off_s[n] = fabs(fit->parted_s[n] - dot(row, fit->fitted));
        }
        fit->noise_s = noise_of(fit);
    }
    double ahead[TERMS], solved[TERMS];
    terms(ahead_s, ahead);
    memcpy(solved, ahead, sizeof solved);
    ldl_solve(TERMS, factors[0], solved);
    return sqrt(dot(ahead, solved));
}
