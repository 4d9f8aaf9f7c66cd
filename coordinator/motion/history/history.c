// SPDX-License-Identifier: Apache-2.0
// See history.h.
#include "coordinator/motion/history/history.h"
#include "coordinator/motion/history/move_way.h"

#include <math.h>

void filament_passed(const struct trapezoid *moves, size_t count, double *place, double *farthest,
                     double *times, double *passed) {
    for (size_t i = 0; i < count; i++) {
        times[2 * i] = moves[i].print_time;
        times[2 * i + 1] = move_end_s(&moves[i]);
        passed[2 * i] = *farthest;
        *place += moves[i].ratio[AXIS_E] * move_way_mm(&moves[i]);
        *farthest = fmax(*farthest, *place);
        passed[2 * i + 1] = *farthest;
    }
}

double highest_printed(const struct trapezoid *moves, size_t count) {
    double highest = 0;
    for (size_t i = 0; i < count; i++) {
        const double *ratio = moves[i].ratio;
        if (ratio[AXIS_E] > 0 && (ratio[AXIS_X] != 0 || ratio[AXIS_Y] != 0))
            highest = fmax(highest, moves[i].start[AXIS_Z]);
    }
    return highest;
}
