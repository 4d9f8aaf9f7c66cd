// SPDX-License-Identifier: Apache-2.0
// Evaluates the shape of a bed. The manual is step_surface.h.
#include "coordinator/motion/steps/times/step_surface.h"

#include <math.h>

static const double STEEPEST = 0.5; // mm per mm, of a bed and of its fading: what is more is no bed
enum { SOLVE_ROUNDS = 64 };

struct height {
    double z, by_x, by_y; // mm, and mm per mm
};

// ------------------------------------------------------------------------------------------- bicubic patches

// A cubic on 0..1 as powers, from its value and slope at 0 and at 1.
static void cubic(const double known[4], double powers[4]) {
    const double rise = known[2] - known[0];
    powers[0] = known[0], powers[1] = known[1];
    powers[2] = 3 * rise - 2 * known[1] - known[3];
    powers[3] = known[1] + known[3] - 2 * rise;
}

static void make_patch(const struct step_surface *g, int i, int j, double *patch) {
    const double scale[4] = {1, g->step_x, g->step_y, g->step_x * g->step_y};
    double along_y[4][4]; // of value and slope by X at both ends of the patch: powers of V
    for (int k = 0; k < 4; k++) {
        double known[4]; // value, slope at Y 0, and at Y 1
        for (int q = 0; q < 2; q++) {
            const double *node = g->nodes + 4 * ((size_t)(j + q) * (size_t)g->points_x + (size_t)(i + k / 2));
            for (int by_y = 0; by_y < 2; by_y++)
                known[2 * q + by_y] = node[k % 2 + 2 * by_y] * scale[k % 2 + 2 * by_y];
        }
        cubic(known, along_y[k]);
    }
    for (int n = 0; n < 4; n++) {
        const double known[4] = {along_y[0][n], along_y[1][n], along_y[2][n], along_y[3][n]};
        double powers[4];
        cubic(known, powers);
        for (int k = 0; k < 4; k++)
            patch[4 * k + n] = powers[k];
    }
}

void step_surface_make_patches(const struct step_surface *g, double *patches) {
    for (int j = 0; j + 1 < g->points_y; j++)
        for (int i = 0; i + 1 < g->points_x; i++, patches += 16)
            make_patch(g, i, j, patches);
}

// The interval of the axis in which AT lies, and where in it, 0..1; OUTSIDE: beyond the edge.
static int interval(double at, double from, double step, int points, double *share, bool *outside) {
    const double u = (at - from) / step, last = points - 1;
    *outside = !(u >= 0 && u <= last);
    if (!(u > 0)) {
        *share = 0;
        return 0;
    }
    const int i = u < last ? (int)u : points - 2;
    *share = u - i < 1 ? u - i : 1;
    return i;
}

static struct height height_at(const struct step_surface *g, double x, double y) {
    double u, v, r[4], slope[4];
    bool out_x, out_y;
    const int i = interval(x, g->from_x, g->step_x, g->points_x, &u, &out_x);
    const int j = interval(y, g->from_y, g->step_y, g->points_y, &v, &out_y);
    const double *c = g->patches + 16 * ((size_t)j * (size_t)(g->points_x - 1) + (size_t)i);
    for (int k = 0; k < 4; k++) { // coefficients of V^k
        r[k] = c[k] + u * (c[4 + k] + u * (c[8 + k] + u * c[12 + k]));
        slope[k] = c[4 + k] + u * (2 * c[8 + k] + u * 3 * c[12 + k]);
    }
    const double by_x = slope[0] + v * (slope[1] + v * (slope[2] + v * slope[3]));
    const double by_y = r[1] + v * (2 * r[2] + v * 3 * r[3]);
    return (struct height){.z = r[0] + v * (r[1] + v * (r[2] + v * r[3])),
                           .by_x = out_x ? 0 : by_x / g->step_x,
                           .by_y = out_y ? 0 : by_y / g->step_y};
}

// ---------------------------------------------------------------------------------------------------- fade

static double fade_at(const struct step_surface *g, double z, double *by_z) {
    *by_z = 0;
    if (!(z > g->fade_from))
        return 1;
    if (!(z < g->fade_to))
        return 0;
    *by_z = -1 / (g->fade_to - g->fade_from);
    return (g->fade_to - z) / (g->fade_to - g->fade_from);
}

void step_surface_add(const struct surface *s, double *at, double *v, double slope[2]) {
    const struct step_surface *g = &s->grid;
    const struct height h = height_at(g, at[AXIS_X], at[AXIS_Y]);
    double by_z;
    const double fade = fade_at(g, at[AXIS_Z], &by_z), over = h.z - g->fade_target;
    if (slope)
        slope[0] = fade * h.by_x, slope[1] = fade * h.by_y;
    at[AXIS_Z] += g->fade_target + fade * over;
    v[AXIS_Z] += fade * (h.by_x * v[AXIS_X] + h.by_y * v[AXIS_Y]) + by_z * v[AXIS_Z] * over;
}

double step_surface_motor_z(const struct step_surface *g, double x, double y, double z) {
    double by_z;
    if (!g->points_x)
        return z;
    return z + g->fade_target + fade_at(g, z, &by_z) * (height_at(g, x, y).z - g->fade_target);
}

// What is added falls by at most STEEPEST per mm of Z, so the planned Z is unique; halving finds it.
double step_surface_planned_z(const struct step_surface *g, double x, double y, double motor_z) {
    if (!g->points_x)
        return motor_z;
    const double over = height_at(g, x, y).z - g->fade_target, most = fabs(over);
    double low = motor_z - g->fade_target - most, high = low + 2 * most, by_z;
    for (int i = 0; i < SOLVE_ROUNDS && low < high; i++) {
        const double z = 0.5 * (low + high);
        if (z + g->fade_target + fade_at(g, z, &by_z) * over < motor_z)
            low = z;
        else
            high = z;
    }
    return high;
}

// -------------------------------------------------------------------------------------------------- bounds

// Control points of a patch as a Bézier surface: the patch and its derivatives lie between theirs.
static void control_points(const struct step_surface *g, int i, int j, double c[4][4]) {
    const double third_x = g->step_x / 3, third_y = g->step_y / 3;
    for (int p = 0; p < 2; p++)
        for (int q = 0; q < 2; q++) {
            const double *n = g->nodes + 4 * ((size_t)(j + q) * (size_t)g->points_x + (size_t)(i + p));
            const double dx = p ? -third_x : third_x, dy = q ? -third_y : third_y;
            const int x0 = 3 * p, x1 = p ? 2 : 1, y0 = 3 * q, y1 = q ? 2 : 1;
            c[x0][y0] = n[0];
            c[x1][y0] = n[0] + dx * n[1];
            c[x0][y1] = n[0] + dy * n[2];
            c[x1][y1] = n[0] + dx * n[1] + dy * n[2] + dx * dy * n[3];
        }
}

static void raise(double *bound, double value) {
    if (fabs(value) > *bound)
        *bound = fabs(value);
}

static void bound_patch(struct surface *s, int i, int j) {
    const double hx = s->grid.step_x, hy = s->grid.step_y;
    double c[4][4];
    control_points(&s->grid, i, j, c);
    for (int p = 0; p < 4; p++)
        for (int q = 0; q < 4; q++) {
            if (p < 3)
                raise(&s->slope_x, 3 / hx * (c[p + 1][q] - c[p][q]));
            if (q < 3)
                raise(&s->slope_y, 3 / hy * (c[p][q + 1] - c[p][q]));
            if (p < 2)
                raise(&s->bend_xx, 6 / (hx * hx) * (c[p + 2][q] - 2 * c[p + 1][q] + c[p][q]));
            if (q < 2)
                raise(&s->bend_yy, 6 / (hy * hy) * (c[p][q + 2] - 2 * c[p][q + 1] + c[p][q]));
            if (p < 3 && q < 3)
                raise(&s->bend_xy, 9 / (hx * hy) * (c[p + 1][q + 1] - c[p + 1][q] - c[p][q + 1] + c[p][q]));
        }
}

void step_surface_set(struct surface *s, const struct step_surface *grid) {
    *s = (struct surface){.grid = *grid};
    if (!grid->points_x)
        return;
    s->end_x = grid->from_x + grid->step_x * (grid->points_x - 1);
    s->end_y = grid->from_y + grid->step_y * (grid->points_y - 1);
    for (int j = 0; j + 1 < grid->points_y; j++)
        for (int i = 0; i + 1 < grid->points_x; i++)
            bound_patch(s, i, j);
}

static bool is_length(double value) {
    return fabs(value) < 1e6; // false for NaN
}

bool step_surface_is_legal(const struct step_surface *g) {
    if (g->points_x == 0)
        return true;
    if (g->points_x < 2 || g->points_x > STEP_SURFACE_POINTS || g->points_y < 2 ||
        g->points_y > STEP_SURFACE_POINTS || !is_length(g->from_x) || !is_length(g->from_y) ||
        !(g->step_x >= 0.1) || !is_length(g->step_x) || !(g->step_y >= 0.1) || !is_length(g->step_y) ||
        !is_length(g->fade_target) || !(g->fade_from <= g->fade_to))
        return false;
    const size_t count = (size_t)g->points_x * (size_t)g->points_y;
    double most = 0;
    for (size_t i = 0; i < count; i++) {
        for (size_t k = 0; k < 4; k++)
            if (!is_length(g->nodes[4 * i + k]))
                return false;
    }
    struct surface s;
    step_surface_set(&s, g);
    // Between nodes the height is not further from theirs than control points are.
    for (int j = 0; j + 1 < g->points_y; j++)
        for (int i = 0; i + 1 < g->points_x; i++) {
            double c[4][4];
            control_points(g, i, j, c);
            for (int p = 0; p < 16; p++)
                raise(&most, c[p / 4][p % 4] - g->fade_target);
        }
    const double fading = g->fade_to - g->fade_from; // may be infinite, or NaN where both are
    return s.slope_x <= STEEPEST && s.slope_y <= STEEPEST && !(most > STEEPEST * fading);
}

double step_surface_steepest(const struct step_surface *g) {
    struct surface s;
    step_surface_set(&s, g);
    return hypot(s.slope_x, s.slope_y);
}

// -------------------------------------------------------------------------------------------- for the spans

bool step_surface_is_smooth(const struct surface *s, double x0, double x1, double y0, double y1, double z0,
                            double z1) {
    const struct step_surface *g = &s->grid;
    return x0 >= g->from_x && x1 <= s->end_x && y0 >= g->from_y && y1 <= s->end_y &&
           (z0 == z1 || z1 <= g->fade_from || z0 >= g->fade_to);
}

double step_surface_change(const struct surface *s, const double far[3]) {
    return s->slope_x * far[AXIS_X] + s->slope_y * far[AXIS_Y] + STEEPEST * far[AXIS_Z];
}

double step_surface_curl(const struct surface *s, const double far[3]) {
    const double x = far[AXIS_X], y = far[AXIS_Y];
    return 0.5 * (s->bend_xx * x * x + 2 * s->bend_xy * x * y + s->bend_yy * y * y);
}

double step_surface_bend(const struct surface *s, double vx, double vy, double ax, double ay) {
    return s->bend_xx * vx * vx + 2 * s->bend_xy * vx * vy + s->bend_yy * vy * vy + s->slope_x * ax +
           s->slope_y * ay;
}
