// SPDX-License-Identifier: Apache-2.0
// The shape of a bed, added to Z as a smooth function of where X and Y are: steppers follow it exactly, on
// the way of every kinematics, and no move is cut for it.
//
// Between the nodes of its grid the height is bicubic (Hermite: height, slopes and twist of the four
// corners), so it has continuous slopes. Beyond its edge the height is that of the nearest place on the edge.
// What is added at the planned Z: TARGET + fade·(height − TARGET), where fade goes from 1 at FADE_FROM to 0
// at FADE_TO.
#ifndef MOTION_STEP_SURFACE_H
#define MOTION_STEP_SURFACE_H

#include "coordinator/motion/steps/steps.h"

#include <stdbool.h>

// A surface, and how fast it bends anywhere: bounds of the derivatives of its height inside the grid.
struct surface {
    struct step_surface grid; // points_x 0: none
    double end_x, end_y;      // mm
    double slope_x, slope_y, bend_xx, bend_xy, bend_yy;
};

void step_surface_set(struct surface *surface, const struct step_surface *grid);

// Moves AT from the planned place to the one that the motors go to, and V, its speeds, likewise. SLOPE (or
// NULL): how fast what is added changes by X and by Y there.
void step_surface_add(const struct surface *surface, double *at, double *v, double slope[2]);

// Whether heights inside X0..X1, Y0..Y1 and Z0..Z1 (planned) are smooth: inside the grid, and fade constant.
bool step_surface_is_smooth(const struct surface *surface, double x0, double x1, double y0, double y1,
                            double z0, double z1);

// The bound of how the height changes when X, Y and Z change by up to FAR, mm, wherever that is.
double step_surface_change(const struct surface *surface, const double far[3]);

// By how much more than by its slope the height can change when X and Y change by up to FAR where it is
// smooth.
double step_surface_curl(const struct surface *surface, const double far[3]);

// The bound of the second derivative of the height by time, mm/s², for speeds and accelerations of X and Y.
double step_surface_bend(const struct surface *surface, double vx, double vy, double ax, double ay);

#endif
