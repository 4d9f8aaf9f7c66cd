// SPDX-License-Identifier: Apache-2.0
// Equations with a small symmetric positive definite matrix, by L·D·Lᵀ (Golub and Van Loan, Matrix
// Computations, section 4.1.2). No pivoting, since such a matrix needs none, whatever the units of its rows
// are.
#ifndef LINEAR_H
#define LINEAR_H

#include <stdint.h>

// cffi: begin
enum { LINEAR_MAX = 4 }; // rows at most

// Replaces MATRIX of N rows, row by row in memory, by its factors: D on the diagonal, L below it. Neither
// reads nor writes what is above the diagonal. A pivot that rounding makes zero or negative becomes the least
// that rounding could leave: a singular matrix has a large inverse with a positive diagonal, and never NaN.
void ldl_factor(uint32_t n, double *matrix);

// Replaces X, the right side, by the solution. FACTORS come from ldl_factor.
void ldl_solve(uint32_t n, const double *factors, double *x);

// Writes the inverse of the matrix, which is symmetric to the last bit.
void ldl_inverse(uint32_t n, const double *factors, double *inverse);
// cffi: end

#endif
