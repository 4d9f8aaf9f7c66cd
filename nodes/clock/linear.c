// SPDX-License-Identifier: Apache-2.0
// See linear.h.
#include "nodes/clock/linear.h"

#include <float.h>
#include <stddef.h>

void ldl_factor(uint32_t n, double *matrix) {
    for (size_t i = 0; i < n; i++) {
        double *row = matrix + i * n;
        double least = DBL_EPSILON * row[i];
        // First the row of L·D, then of L.
        for (size_t j = 0; j < i; j++)
            for (size_t k = 0; k < j; k++)
                row[j] -= row[k] * matrix[j * n + k];
        for (size_t j = 0; j < i; j++) {
            double scaled = row[j];
            row[j] /= matrix[j * n + j];
            row[i] -= scaled * row[j];
        }
        if (row[i] < least)
            row[i] = least;
    }
}

void ldl_solve(uint32_t n, const double *factors, double *x) {
    for (size_t i = 0; i < n; i++)
        for (size_t k = 0; k < i; k++)
            x[i] -= factors[i * n + k] * x[k];
    for (size_t i = 0; i < n; i++)
        x[i] /= factors[i * n + i];
    for (size_t i = n; i-- > 0;)
        for (size_t k = i + 1; k < n; k++)
            x[i] -= factors[k * n + i] * x[k];
}

void ldl_inverse(uint32_t n, const double *factors, double *inverse) {
    for (size_t column = 0; column < n; column++) {
        double x[LINEAR_MAX] = {0};
        x[column] = 1;
        ldl_solve(n, factors, x);
        for (size_t i = column; i < n; i++)
            inverse[i * n + column] = inverse[column * n + i] = x[i];
    }
}
