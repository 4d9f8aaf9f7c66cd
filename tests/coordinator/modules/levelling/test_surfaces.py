"""Fits of surfaces, against surfaces that are known."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from coordinator.modules.levelling.surfaces import (
    adjustments,
    bilinear_heights,
    fit_plane,
    rank,
    spread_mm,
)

NUMBER = st.floats(-5, 5)
PLACE = st.tuples(st.floats(-300, 300), st.floats(-300, 300))
CORNERS = [(10.0, 20.0), (15.0, 180.0), (190.0, 185.0), (180.0, 12.0)]


@given(NUMBER, st.floats(-0.05, 0.05), st.floats(-0.05, 0.05), PLACE)
def test_a_plane_is_found_by_its_points(z: float, a: float, b: float, place: tuple[float, float]) -> None:
    plane = fit_plane([(x, y, z + a * x + b * y) for x, y in CORNERS])
    assert plane.height(place) == pytest.approx(z + a * place[0] + b * place[1], abs=1e-9)


@given(st.lists(NUMBER, min_size=4, max_size=4))
def test_a_plane_is_the_nearest_one(heights: list[float]) -> None:
    """By the normal equations, which share nothing with the fit."""
    matrix = np.array([(1, *place) for place in CORNERS])
    exact = np.linalg.solve(matrix.T @ matrix, matrix.T @ np.array(heights))
    points = [(x, y, z) for (x, y), z in zip(CORNERS, heights, strict=True)]
    assert fit_plane(points).height((0.0, 0.0)) == pytest.approx(exact[0], abs=1e-9)


def test_across_points_on_one_line_a_plane_is_level() -> None:
    plane = fit_plane([(10, 100, 1.0), (210, 100, 2.0)])
    assert plane.height((110, 0)) == pytest.approx(1.5)
    assert plane.height((310, 500)) == pytest.approx(2.5)


SLOPE = st.floats(-0.05, 0.05)


@given(st.tuples(NUMBER, SLOPE, SLOPE, st.floats(-1e-4, 1e-4)), PLACE)
def test_a_twisted_surface_is_found_by_its_corners(
    surface: tuple[float, float, float, float], place: tuple[float, float]
) -> None:
    z, a, b, c = surface

    def height(x: float, y: float) -> float:
        return z + a * x + b * y + c * x * y

    (found,) = bilinear_heights([(x, y, height(x, y)) for x, y in CORNERS], [place])
    assert found == pytest.approx(height(*place), abs=1e-8)


@given(st.lists(NUMBER, min_size=2, max_size=6))
def test_motors_rise_to_where_the_bed_is_and_their_mean_stays(heights: list[float]) -> None:
    by, mean = adjustments(heights)
    assert sum(by) == pytest.approx(0, abs=1e-9)
    assert [height - each for height, each in zip(heights, by, strict=True)] == pytest.approx(
        [mean] * len(heights)
    )


def test_how_places_lie() -> None:
    assert rank([(1, 1), (1, 1)]) == 0
    assert rank([(1, 1), (2, 2), (5, 5)]) == 1
    assert rank([(1, 1), (2, 2), (5, 4)]) == 2
    assert spread_mm([(0, 0, 1.5), (1, 1, -0.5), (2, 2, 0)]) == 2
