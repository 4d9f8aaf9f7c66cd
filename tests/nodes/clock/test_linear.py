"""Equations with small symmetric matrices, against numpy and against exact fractions."""

from fractions import Fraction
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from nodes.clock._clock import ffi, lib
from tests.nodes.bounds import Array

SIZES = range(1, lib.LINEAR_MAX + 1)
ABOVE = 1e300
"""Stands above the diagonal, which must not be read or written."""

elements = st.floats(-1, 1)
scales = st.floats(-12, 12).map(lambda exponent: 10.0**exponent)
"""Of the units of a row: leads, rates and curvatures differ by so much."""


@st.composite
def matrices(draw: st.DrawFn) -> tuple[Array, Array]:
    """Return a matrix with a condition under about 100, and the scales of its rows and columns."""
    n = draw(st.sampled_from(SIZES))
    root = np.array(draw(st.lists(st.lists(elements, min_size=n, max_size=n), min_size=n, max_size=n)))
    scale = np.array(draw(st.lists(scales, min_size=n, max_size=n)))
    return root @ root.T + 0.2 * np.eye(n), scale


def factor(matrix: Array) -> Any:
    """Return the factors of MATRIX."""
    n = len(matrix)
    factors = ffi.new("double[]", np.where(np.tri(n), matrix, ABOVE).ravel().tolist())
    lib.ldl_factor(n, factors)
    return factors


def solve(matrix: Array, right: Array) -> Array:
    """Return X for which MATRIX @ X is RIGHT."""
    x = ffi.new("double[]", right.tolist())
    lib.ldl_solve(len(matrix), factor(matrix), x)
    return np.array(list(x))


def inverse(matrix: Array) -> Array:
    """Return the inverse of MATRIX."""
    n = len(matrix)
    found = ffi.new("double[]", n * n)
    lib.ldl_inverse(n, factor(matrix), found)
    return np.array(list(found)).reshape(n, n)


@given(matrices())
def test_the_factors_multiply_to_the_matrix(given_: tuple[Array, Array]) -> None:
    matrix, scale = given_
    matrix = matrix * np.outer(scale, scale)
    n = len(matrix)
    found = np.array(list(factor(matrix))).reshape(n, n)
    lower, diagonal = np.tril(found, -1) + np.eye(n), np.diag(found)
    assert np.all(diagonal > 0)
    deviation = np.sqrt(np.diag(matrix))
    product = lower @ np.diag(diagonal) @ lower.T
    assert np.max(np.abs(product - matrix) / np.outer(deviation, deviation)) < 1e-14
    assert np.all(found[~np.tri(n, dtype=bool)] == ABOVE)


@given(matrices(), st.lists(elements, min_size=4, max_size=4))
def test_solution_and_inverse_are_those_of_numpy_whatever_the_units(
    given_: tuple[Array, Array], right: list[float]
) -> None:
    matrix, scale = given_
    n = len(matrix)
    solution, wanted = np.linalg.solve(matrix, right[:n]), np.linalg.inv(matrix)
    scaled = matrix * np.outer(scale, scale)
    assert np.max(np.abs(solve(scaled, np.array(right[:n]) * scale) * scale - solution)) < 1e-12
    found = inverse(scaled)
    assert np.max(np.abs(found * np.outer(scale, scale) - wanted)) < 1e-12
    assert np.all(found == found.T)


def test_a_hilbert_matrix_is_inverted_as_exactly_as_its_condition_allows() -> None:
    """Its inverse consists of whole numbers; the condition of 4 by 4 is 15,514."""
    matrix = np.array([[float(Fraction(1, i + j + 1)) for j in range(4)] for i in range(4)])
    wanted = [
        [16, -120, 240, -140],
        [-120, 1200, -2700, 1680],
        [240, -2700, 6480, -4200],
        [-140, 1680, -4200, 2800],
    ]
    assert np.max(np.abs(inverse(matrix) / wanted - 1)) < 1e-11


@pytest.mark.parametrize("sign", [1, -1])
def test_a_singular_matrix_has_a_large_finite_inverse_of_positive_diagonal(sign: int) -> None:
    """... also one that rounding has made slightly worse than singular."""
    for off in (1.0, 1 + 2e-16):
        found = inverse(np.array([[4.0, sign * 2 * off], [sign * 2 * off, 1.0]]))
        assert np.all(np.isfinite(found))
        assert np.diag(found) == pytest.approx([2.0**50, 2.0**52], rel=1e-9)
        assert found[0, 1] == pytest.approx(-sign * 2.0**51, rel=1e-9)
