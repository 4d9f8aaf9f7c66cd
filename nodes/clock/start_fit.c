// SPDX-License-Identifier: Apache-2.0
// See start_fit.h.
#include "nodes/clock/start_fit.h"

#include "nodes/clock/linear.h"
#include "nodes/clock/normal.h"

#include <math.h>
#include <string.h>

_Static_assert((int)START_STATES <= (int)LINEAR_MAX, "linear.h solves for all states");

// Writes what the bound of an exchange limits: along · state <= bound.
static void direction(const struct start_exchange *exchange, int way, double along[START_STATES]) {
    double sign = way == 0 ? 1 : -1, at_s = exchange->at_s;
    along[0] = sign;
    along[1] = sign * at_s;
    along[2] = sign * (at_s * at_s / 2);
    along[3] = 1;
}

static double dot(const double *a, const double *b) {
    double sum = 0;
    for (int i = 0; i < START_STATES; i++)
        sum += a[i] * b[i];
    return sum;
}

void start_fit_solve(struct start_fit *fit) {
    double information[START_STATES][START_STATES] = {{0}};
    memcpy(fit->mean, fit->pull, sizeof fit->mean);
    for (int i = 0; i < START_STATES; i++)
        information[i][i] = fit->prior[i];
    for (uint32_t n = 0; n < fit->count; n++)
        for (int way = 0; way < START_WAYS; way++) {
            const struct start_exchange *exchange = &fit->exchanges[n];
            double along[START_STATES];
            direction(exchange, way, along);
            for (int i = 0; i < START_STATES; i++) {
                double scaled = exchange->precision[way] * along[i];
                for (int j = 0; j <= i; j++)
                    information[i][j] += scaled * along[j];
                fit->mean[i] += exchange->shift[way] * along[i];
            }
        }
    ldl_factor(START_STATES, information[0]);
    ldl_solve(START_STATES, information[0], fit->mean);
    ldl_inverse(START_STATES, information[0], fit->covariance[0]);
}

double start_fit_gaps(const struct start_fit *fit, double most_s) {
    double sum_s = 0;
    for (uint32_t n = 0; n < fit->count; n++)
        for (int way = 0; way < START_WAYS; way++) {
            double along[START_STATES];
            direction(&fit->exchanges[n], way, along);
            sum_s += fmin(fmax(fit->exchanges[n].bound_s[way] - dot(along, fit->mean), 0), most_s);
        }
    return sum_s;
}

void start_fit_sweep(struct start_fit *fit, double spread_s, double noise_s, double loose_s, double damping) {
    for (uint32_t n = 0; n < fit->count; n++)
        for (int way = 0; way < START_WAYS; way++) {
            struct start_exchange *exchange = &fit->exchanges[n];
            double *precision = &exchange->precision[way], *shift = &exchange->shift[way];
            double along[START_STATES], column[START_STATES];
            direction(exchange, way, along);
            for (int i = 0; i < START_STATES; i++)
                column[i] = dot(fit->covariance[i], along);
            double variance = dot(along, column), middle = dot(along, fit->mean);
            // Each bound is applied to the belief from all the others.
            double other = 1 / fmax(1 / variance - *precision, 1e-3 / variance);
            double centre = other * (middle / variance - *shift);
            double tilt = exchange->bound_s[way] - middle < loose_s ? 1 / spread_s : 0;
            double s = sqrt(other + noise_s * noise_s);
            double k = (exchange->bound_s[way] - centre) / s - tilt * s;
            double r = normal_hazard(k);
            double cut = fmin(r * (k + r), 1 - 1e-9) / (s * s), push = tilt - r / s, left = 1 - other * cut;
            *precision += damping * (cut / left - *precision);
            *shift += damping * ((centre * cut + push) / left - *shift);
        }
}
