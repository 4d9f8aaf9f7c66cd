// SPDX-License-Identifier: Apache-2.0
// What planned moves do, looked at as a whole: which path the tool takes, how much filament passes a hot end,
// how high was printed. All memory is the caller's; nothing allocates.
#ifndef MOTION_HISTORY_H
#define MOTION_HISTORY_H

#include "coordinator/motion/trapezoid.h"

#include <stddef.h>
#include <stdint.h>

// cffi: begin
// A corner of the tool's path.
struct path_corner {
    double at[3];    // X Y Z, mm
    double time_s;   // print time when the tool is there
    int64_t extrude; // whether filament was pushed on the way there
};

// Working memory of toolpath_thin: a corner that may go, and how far it is from the line between its
// neighbours.
struct path_detour {
    double away_mm;
    size_t corner;
};

// Adds the corners of MOVES, in order, behind the COUNT that are there and returns how many there are then:
// at most two more for each move. A move that begins where the tool is not is a jump, without extrusion; one
// that moves other axes only is no corner.
size_t toolpath_add(struct path_corner *corners, size_t count, const struct trapezoid *moves,
                    size_t moves_count);

// Drops corners until KEEP of COUNT are left, every other one at most, those first that are nearest to the
// line between their neighbours; none at which extrusion begins or ends. When that leaves more than MOST, the
// oldest go. DETOURS has room for COUNT / 2. Returns how many are left.
size_t toolpath_thin(struct path_corner *corners, size_t count, size_t keep, size_t most,
                     struct path_detour *detours);

// Copies COUNT corners to columns of X, Y, Z and time, each rounded to 0.001 mm or 0.001 s.
void toolpath_columns(const struct path_corner *corners, size_t count, double *x, double *y, double *z,
                      double *time_s);

// How much new filament passes a hot end, mm: what comes again after it was pulled back does not count. PLACE
// is where the filament is, FARTHEST the farthest it has been; both go on. For each move two entries, its
// begin and its end: print time to TIMES (s), what has passed by then to PASSED.
void filament_passed(const struct trapezoid *moves, size_t count, double *place, double *farthest,
                     double *times, double *passed);

// The greatest Z at which a move along X or Y begins that pushes filament, mm; 0: there is none above 0.
double highest_printed(const struct trapezoid *moves, size_t count);
// cffi: end

#endif
