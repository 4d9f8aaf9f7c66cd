"""Symmetric linear equations of a few unknowns, by Cholesky's decomposition."""

import math
from collections.abc import Sequence
from operator import mul

Matrix = Sequence[Sequence[float]]
"""Symmetric and positive definite, by rows."""


def cholesky(matrix: Matrix) -> list[list[float]]:
    """Return the lower triangle L with L·Lᵀ = MATRIX, by rows; raises ValueError when there is none."""
    lower: list[list[float]] = []
    for i, values in enumerate(matrix):
        row: list[float] = []
        for j in range(i):
            row.append((values[j] - sum(map(mul, row, lower[j]))) / lower[j][j])
        row.append(math.sqrt(values[i] - sum(map(mul, row, row))))
        lower.append(row)
    return lower


def solve(matrix: Matrix, values: Sequence[float]) -> list[float]:
    """Return x with MATRIX·x = VALUES; raises ValueError when MATRIX is not positive definite."""
    lower = cholesky(matrix)
    found: list[float] = []
    for row, value in zip(lower, values, strict=True):
        found.append((value - sum(map(mul, row, found))) / row[len(found)])
    for i in reversed(range(len(lower))):
        later = sum(lower[j][i] * found[j] for j in range(i + 1, len(lower)))
        found[i] = (found[i] - later) / lower[i][i]
    return found


def inverse(matrix: Matrix) -> list[list[float]]:
    """Return the inverse of MATRIX; raises ValueError when it is not positive definite."""
    size = len(matrix)
    columns = [solve(matrix, [float(i == j) for j in range(size)]) for i in range(size)]
    return [[(columns[i][j] + columns[j][i]) / 2 for j in range(size)] for i in range(size)]
