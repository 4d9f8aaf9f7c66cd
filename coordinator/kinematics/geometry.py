"""Vectors, three linear equations, and where spheres meet."""

import math
from collections.abc import Sequence
from operator import mul
from typing import Final

from coordinator.kinematics.base import Point

_DEPENDENT: Final = 1e-9
"""Of its length: a column of which less than this is new depends on those before it."""


def subtract(a: Point, b: Point) -> Point:
    """Return a - b."""
    return (a[0] - b[0], a[1] - b[1], a[2] - b[2])


def dot(a: Point, b: Point) -> float:
    """Return the inner product."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def cross(a: Point, b: Point) -> Point:
    """Return the vector product."""
    return (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])


def along(start: Point, *steps: tuple[float, Point]) -> Point:
    """Return START plus the sum of factor * vector."""
    x, y, z = start
    for factor, vector in steps:
        x, y, z = x + factor * vector[0], y + factor * vector[1], z + factor * vector[2]
    return (x, y, z)


def solve(rows: tuple[Point, Point, Point], values: Point) -> Point:
    """Return p with rows·p = values (Cramer's rule); the rows are independent."""
    a, b, c = rows
    columns = (cross(b, c), cross(c, a), cross(a, b))
    determinant = dot(a, columns[0])
    x, y, z = (
        sum(value * column[i] for value, column in zip(values, columns, strict=True)) / determinant
        for i in range(3)
    )
    return (x, y, z)


def fit_point(rows: Sequence[Sequence[float]], values: Sequence[float]) -> Point:
    """Return the p with rows·p nearest to values (least squares); what no row determines is 0.

    By modified Gram-Schmidt: Björck, Numerical Methods for Least Squares Problems, section 2.4.
    """
    left = list(values)
    directions: list[tuple[int, list[float], list[float]]] = []
    for axis in range(3):
        column = [float(row[axis]) for row in rows]
        length = math.hypot(*column)
        shares = [0.0] * axis
        for before, direction, _ in directions:
            shares[before] = sum(map(mul, direction, column))
            column = [c - shares[before] * d for c, d in zip(column, direction, strict=True)]
        rest = math.hypot(*column)
        if rest > _DEPENDENT * length:
            directions.append((axis, [c / rest for c in column], [*shares, rest]))
    solved = [0.0, 0.0, 0.0]
    for axis, direction, _ in directions:
        solved[axis] = sum(map(mul, direction, left))
        left = [v - solved[axis] * d for v, d in zip(left, direction, strict=True)]
    for index in reversed(range(len(directions))):
        axis, _, own = directions[index]
        for later, _, shares in directions[index + 1 :]:
            solved[axis] -= shares[axis] * solved[later]
        solved[axis] /= own[axis]
    x, y, z = solved
    return (x, y, z)


def spheres_meet(
    centres: tuple[Point, Point, Point], radii: tuple[float, float, float]
) -> tuple[Point, Point]:
    """Return the two points on three spheres, the lower one first; ValueError when there are none.

    Trilateration (https://en.wikipedia.org/wiki/True-range_multilateration): in a frame whose origin is the
    first centre, whose first axis goes through the second and whose plane holds the third, the differences of
    the spheres' equations are linear in the first two coordinates.
    """
    first, second, third = centres
    to_second, to_third = subtract(second, first), subtract(third, first)
    distance = math.sqrt(dot(to_second, to_second))
    normal = cross(to_second, to_third)
    area = math.sqrt(dot(normal, normal))
    if area <= 1e-9 * max(dot(to_second, to_second), dot(to_third, to_third)):
        raise ValueError("the centres are on one line")
    e1 = along((0.0, 0.0, 0.0), (1 / distance, to_second))
    e3 = along((0.0, 0.0, 0.0), (1 / area, normal))
    e2 = cross(e3, e1)
    r1, r2, r3 = (radius * radius for radius in radii)
    i, j = dot(e1, to_third), dot(e2, to_third)
    u = (r1 - r2 + distance * distance) / (2 * distance)
    v = (r1 - r3 + i * i + j * j - 2 * i * u) / (2 * j)
    height2 = r1 - u * u - v * v
    if height2 < -1e-9 * r1:
        raise ValueError("the spheres do not meet")
    height = math.sqrt(max(height2, 0.0))
    one, other = along(first, (u, e1), (v, e2), (height, e3)), along(first, (u, e1), (v, e2), (-height, e3))
    return (one, other) if one[2] < other[2] else (other, one)
