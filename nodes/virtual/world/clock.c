// SPDX-License-Identifier: Apache-2.0
// See clock.h. Doubles contain differences only: within a piece of three hours at 168 MHz the rounding error
// is below a thousandth of a tick.
#include "nodes/virtual/world/clock.h"

#include <math.h>

static double rate_of(const struct crystal *crystal, double ppm) {
    return crystal->nominal_hz * (1.0 + ppm * 1e-6) * 1e-9;
}

void crystal_start(struct crystal *crystal, double nominal_hz, uint64_t at_ns, uint64_t ticks, double ppm) {
    crystal->nominal_hz = nominal_hz;
    crystal->count = 1;
    crystal->pieces[0] = (struct clock_piece){.at_ns = at_ns, .ticks = ticks, .rate = rate_of(crystal, ppm)};
}

static const struct clock_piece *piece_at(const struct crystal *crystal, uint64_t at_ns) {
    uint32_t i = crystal->count - 1;
    while (i > 0 && crystal->pieces[i].at_ns > at_ns)
        i--;
    return &crystal->pieces[i];
}

// Ticks since the piece's whole ticks.
static double advance(const struct clock_piece *piece, double passed_ns) {
    return piece->fraction + (piece->rate + piece->bend * passed_ns) * passed_ns;
}

// Before the first piece its rate is extrapolated, which only occurs for the rounding of one ns.
static double passed(const struct clock_piece *piece, uint64_t at_ns) {
    return at_ns >= piece->at_ns ? (double)(at_ns - piece->at_ns) : -(double)(piece->at_ns - at_ns);
}

uint64_t crystal_ticks(const struct crystal *crystal, uint64_t at_ns) {
    const struct clock_piece *piece = piece_at(crystal, at_ns);
    return piece->ticks + (uint64_t)(int64_t)floor(advance(piece, passed(piece, at_ns)));
}

int crystal_change(struct crystal *crystal, uint64_t at_ns, double ppm, double ppm_per_s) {
    const struct clock_piece *last = &crystal->pieces[crystal->count - 1];
    if (at_ns < last->at_ns || (crystal->count == CLOCK_PIECES_MAX && at_ns > last->at_ns))
        return -1;
    double ticks = advance(last, passed(last, at_ns)), whole = floor(ticks);
    struct clock_piece next = {
        .at_ns = at_ns,
        .ticks = last->ticks + (uint64_t)whole,
        .fraction = ticks - whole,
        .rate = rate_of(crystal, ppm),
        .bend = crystal->nominal_hz * ppm_per_s * 1e-6 * 1e-18 / 2,
    };
    if (at_ns > last->at_ns)
        crystal->count++;
    crystal->pieces[crystal->count - 1] = next;
    return 0;
}

double crystal_ppm(const struct crystal *crystal, uint64_t at_ns) {
    const struct clock_piece *piece = piece_at(crystal, at_ns);
    double rate = piece->rate + 2 * piece->bend * passed(piece, at_ns);
    return (rate * 1e9 / crystal->nominal_hz - 1.0) * 1e6;
}

static const struct clock_piece *piece_of_ticks(const struct crystal *crystal, uint64_t ticks) {
    uint32_t i = crystal->count - 1;
    while (i > 0 && crystal->pieces[i].ticks >= ticks)
        i--;
    return &crystal->pieces[i];
}

// Returns the ns since the start of PIECE at which the clock becomes TICKS.
static double time_in_piece(const struct clock_piece *piece, uint64_t ticks) {
    double wanted = (double)(int64_t)(ticks - piece->ticks) - piece->fraction;
    double passed_ns = wanted / piece->rate;
    // Newton's method: the ramp changes the rate by some ppm.
    for (int i = 0; piece->bend != 0 && i < 3; i++)
        passed_ns -= (advance(piece, passed_ns) - piece->fraction - wanted) /
                     (piece->rate + 2 * piece->bend * passed_ns);
    return passed_ns;
}

uint64_t crystal_time(const struct crystal *crystal, uint64_t ticks) {
    const struct clock_piece *piece = piece_of_ticks(crystal, ticks);
    double passed_ns = ceil(time_in_piece(piece, ticks));
    if (!(passed_ns < 0x1p62))
        return UINT64_MAX;
    uint64_t at_ns = piece->at_ns + (uint64_t)(int64_t)passed_ns;
    // Rounding may be off by one; both directions have to agree to the ns.
    while (crystal_ticks(crystal, at_ns) < ticks)
        at_ns++;
    while (at_ns > 0 && crystal_ticks(crystal, at_ns - 1) >= ticks)
        at_ns--;
    return at_ns;
}

int64_t crystal_time_ps(const struct crystal *crystal, uint64_t ticks) {
    const struct clock_piece *piece = piece_of_ticks(crystal, ticks);
    double passed_ns = time_in_piece(piece, ticks), whole = floor(passed_ns);
    return ((int64_t)piece->at_ns + (int64_t)whole) * 1000 + (int64_t)floor((passed_ns - whole) * 1000);
}
