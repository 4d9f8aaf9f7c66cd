// SPDX-License-Identifier: Apache-2.0
// A node's crystal: its clock as a function of true time, exact to a fraction of a tick over days.
//
// The function consists of pieces, in each of which the rate is constant or changes linearly (a temperature
// ramp); where pieces meet, neither the clock nor, in a ramp, its rate jumps.
#ifndef WORLD_CLOCK_H
#define WORLD_CLOCK_H

#include <stdint.h>

enum { CLOCK_PIECES_MAX = 64 };

struct clock_piece {
    uint64_t at_ns, ticks; // ticks at at_ns, integer part
    double fraction;       // fractional part, 0 <= fraction < 1
    double rate;           // ticks per ns at at_ns
    double bend;           // half the change of the rate, ticks per ns²
};

struct crystal {
    double nominal_hz;
    uint32_t count;
    struct clock_piece pieces[CLOCK_PIECES_MAX];
};

// Begins with TICKS at AT_NS and a rate PPM above nominal.
void crystal_start(struct crystal *crystal, double nominal_hz, uint64_t at_ns, uint64_t ticks, double ppm);
// From AT_NS (not before the last piece) on the rate is PPM above nominal and rises by PPM_PER_S. -1: no room
// for one more piece, or too early.
int crystal_change(struct crystal *crystal, uint64_t at_ns, double ppm, double ppm_per_s);
// The rate at AT_NS, ppm above nominal.
double crystal_ppm(const struct crystal *crystal, uint64_t at_ns);
// The clock at AT_NS: whole ticks.
uint64_t crystal_ticks(const struct crystal *crystal, uint64_t at_ns);
// The first ns at which the clock is TICKS or more; UINT64_MAX: out of range.
uint64_t crystal_time(const struct crystal *crystal, uint64_t ticks);
// The instant at which the clock becomes TICKS, in ps of true time.
int64_t crystal_time_ps(const struct crystal *crystal, uint64_t ticks);

#endif
