// SPDX-License-Identifier: Apache-2.0
// The arithmetic of pulse_fit.py, which explains the method: a robust parabola through readings.
#ifndef PULSE_PARABOLA_H
#define PULSE_PARABOLA_H

#include <stdint.h>

// cffi: begin
enum { PULSE_PAIRS_MAX = 64 };

struct pulse_parabola {
    uint32_t count; // of readings, 1..PULSE_PAIRS_MAX
    // The readings: seconds of the reference before the last one (<= 0), and by how much more the node's
    // clock has moved.
    double at_s[PULSE_PAIRS_MAX];
    double parted_s[PULSE_PAIRS_MAX];
    // Their distances from the parabola; before a fit, those by which they are doubted.
    double off_s[PULSE_PAIRS_MAX];
    // The parabola: offset (s), rate, curvature (1/s) at time 0.
    double fitted[3];
    double noise_s; // standard deviation of a reading
};

// Fits the parabola. RATE_SD, CURVATURE_SD: standard deviations before any reading. Returns the standard
// deviation of the parabola AHEAD_S after time 0.
double pulse_parabola_fit(struct pulse_parabola *fit, double rate_sd, double curvature_sd, double ahead_s);
// cffi: end

#endif
