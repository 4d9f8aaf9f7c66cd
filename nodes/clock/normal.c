// SPDX-License-Identifier: Apache-2.0
// See normal.h.
#include "nodes/clock/normal.h"

#include <math.h>

#define DENSITY_AT_0 0.3989422804014327
#define ROOT_HALF 0.7071067811865476

double normal_hazard(double k) {
    if (k < -25.0) {
        // Enough terms for an accurate difference of r * (k + r), about 1 - x * x, to 1.
        double x = 1 / k, cube = x * x * x;
        return -k - x + 2 * cube - 10 * cube * x * x;
    }
    return exp(-k * k / 2) * DENSITY_AT_0 / (0.5 * erfc(-k * ROOT_HALF));
}
