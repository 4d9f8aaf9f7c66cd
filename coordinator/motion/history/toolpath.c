// SPDX-License-Identifier: Apache-2.0
// See history.h.
#include "coordinator/motion/history/history.h"
#include "coordinator/motion/history/move_way.h"

#include <math.h>
#include <stdbool.h>
#include <stdlib.h>
#include <string.h>

enum { XYZ = 3 };

static const double SAME_MM = 1e-6;

static bool is_same(const double a[XYZ], const double b[XYZ]) {
    for (int i = 0; i < XYZ; i++) {
        if (fabs(a[i] - b[i]) > SAME_MM)
            return false;
    }
    return true;
}

static void put(struct path_corner *corner, const double at[XYZ], double time_s, bool extrude) {
    memcpy(corner->at, at, sizeof(corner->at));
    corner->time_s = time_s;
    corner->extrude = extrude;
}

size_t toolpath_add(struct path_corner *corners, size_t count, const struct trapezoid *moves,
                    size_t moves_count) {
    for (size_t i = 0; i < moves_count; i++) {
        const struct trapezoid *m = &moves[i];
        if (!count || !is_same(corners[count - 1].at, m->start))
            put(&corners[count++], m->start, m->print_time, false);
        double end[XYZ];
        for (int axis = 0; axis < XYZ; axis++)
            end[axis] = m->start[axis] + m->ratio[axis] * move_way_mm(m);
        if (!is_same(corners[count - 1].at, end))
            put(&corners[count++], end, move_end_s(m), m->ratio[AXIS_E] > 0);
    }
    return count;
}

// How far B is from the line between A and C.
static double detour_mm(const double a[XYZ], const double b[XYZ], const double c[XYZ]) {
    double along = 0, chord = 0, away = 0;
    for (int i = 0; i < XYZ; i++) {
        along += (b[i] - a[i]) * (c[i] - a[i]);
        chord += (c[i] - a[i]) * (c[i] - a[i]);
    }
    const double share = fmin(fmax(along / fmax(chord, 1e-12), 0), 1);
    for (int i = 0; i < XYZ; i++) {
        const double off = b[i] - a[i] - share * (c[i] - a[i]);
        away += off * off;
    }
    return sqrt(away);
}

static int by_detour(const void *left, const void *right) {
    const struct path_detour *a = left, *b = right;
    if (a->away_mm != b->away_mm)
        return a->away_mm < b->away_mm ? -1 : 1;
    return a->corner < b->corner ? -1 : a->corner > b->corner;
}

size_t toolpath_thin(struct path_corner *corners, size_t count, size_t keep, size_t most,
                     struct path_detour *detours) {
    size_t candidates = 0;
    for (size_t i = 1; i + 1 < count; i += 2) {
        if (corners[i].extrude == corners[i + 1].extrude)
            detours[candidates++] = (struct path_detour){
                .away_mm = detour_mm(corners[i - 1].at, corners[i].at, corners[i + 1].at), .corner = i};
    }
    qsort(detours, candidates, sizeof(*detours), by_detour);
    const size_t surplus = count > keep ? count - keep : 0;
    const size_t dropped = candidates < surplus ? candidates : surplus;
    for (size_t i = 0; i < dropped; i++)
        corners[detours[i].corner].time_s = NAN;
    // All corners matter: the oldest go.
    const size_t begin = count - dropped > most ? surplus : 0;
    size_t kept = 0;
    for (size_t i = begin; i < count; i++) {
        if (!isnan(corners[i].time_s))
            corners[kept++] = corners[i];
    }
    return kept;
}

static double rounded(double value) {
    return rint(value * 1000) / 1000;
}

void toolpath_columns(const struct path_corner *corners, size_t count, double *x, double *y, double *z,
                      double *time_s) {
    for (size_t i = 0; i < count; i++) {
        x[i] = rounded(corners[i].at[AXIS_X]);
        y[i] = rounded(corners[i].at[AXIS_Y]);
        z[i] = rounded(corners[i].at[AXIS_Z]);
        time_s[i] = rounded(corners[i].time_s);
    }
}
