// SPDX-License-Identifier: Apache-2.0
// Where the nozzle of a delta is: the lower one of the two places that are a rod's length from each joint.
// By trilateration: in a frame with its origin at the first joint and the second one on its x axis.
#include "plant/plant.h"

#include <math.h>

static double dot(const double a[3], const double b[3]) {
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
}

void plant_delta_nozzle(const struct plant_delta *delta, const double heights[3], double nozzle[3]) {
    double joints[3][3], ex[3], ey[3], ez[3];
    for (int i = 0; i < 3; i++) {
        joints[i][0] = delta->x[i];
        joints[i][1] = delta->y[i];
        joints[i][2] = heights[i];
    }
    double second[3], third[3];
    for (int k = 0; k < 3; k++) {
        second[k] = joints[1][k] - joints[0][k];
        third[k] = joints[2][k] - joints[0][k];
    }
    double d = sqrt(dot(second, second));
    for (int k = 0; k < 3; k++)
        ex[k] = second[k] / d;
    double i = dot(ex, third);
    for (int k = 0; k < 3; k++)
        ey[k] = third[k] - i * ex[k];
    double j = sqrt(dot(ey, ey));
    for (int k = 0; k < 3; k++)
        ey[k] /= j;
    ez[0] = ex[1] * ey[2] - ex[2] * ey[1];
    ez[1] = ex[2] * ey[0] - ex[0] * ey[2];
    ez[2] = ex[0] * ey[1] - ex[1] * ey[0];
    const double *rod = delta->rod;
    double x = (rod[0] * rod[0] - rod[1] * rod[1] + d * d) / (2 * d);
    double y = (rod[0] * rod[0] - rod[2] * rod[2] + i * i + j * j - 2 * i * x) / (2 * j);
    double above = rod[0] * rod[0] - x * x - y * y;
    double z = above > 0 ? sqrt(above) : 0; // rods that do not meet are stretched
    double sign = ez[2] > 0 ? -1 : 1;
    for (int k = 0; k < 3; k++)
        nozzle[k] = joints[0][k] + x * ex[k] + y * ey[k] + sign * z * ez[k];
}
