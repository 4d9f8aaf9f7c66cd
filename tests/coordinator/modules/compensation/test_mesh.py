"""Meshes as surfaces: through their points, exact for what they can express, and where they are probed."""

import math
from typing import Any

import numpy as np
import pytest

from coordinator.modules.compensation.bed_mesh_options import Fade
from coordinator.modules.compensation.mesh import (
    BICUBIC,
    LAGRANGE,
    Grid,
    Mesh,
    Place,
    Region,
    adapted,
    fitting_algorithm,
)

FIRST, LAST = (10.0, 20.0), (190.0, 170.0)


def mesh_of(height: Any, columns: int, rows: int, algorithm: str = LAGRANGE, tension: float = 0.2) -> Mesh:
    x, y = np.meshgrid(np.linspace(FIRST[0], LAST[0], columns), np.linspace(FIRST[1], LAST[1], rows))
    return Mesh(tuple(map(tuple, height(x, y).tolist())), FIRST, LAST, algorithm, tension)


def worst(mesh: Mesh, height: object) -> float:
    """Return how far the surface of MESH is from HEIGHT, at random places on it."""
    rng = np.random.default_rng(3)
    xs, ys = rng.uniform(FIRST[0], LAST[0], 300), rng.uniform(FIRST[1], LAST[1], 300)
    surface = mesh.surface()
    found = np.array([surface.motor_z(x, y, 0.0) for x, y in zip(xs, ys, strict=True)])
    return float(np.abs(found - height(xs, ys)).max())  # type: ignore[operator]


def tilted(x: object, y: object) -> object:
    return 0.3 + 0.004 * x - 0.002 * y  # type: ignore[operator]


def bowed(x: object, y: object) -> object:
    u, v = (x - 100) / 100, (y - 95) / 100  # type: ignore[operator]
    return 0.3 * (1 - u**2 - v**2) + 0.05 * u * v + 0.02 * u**3


@pytest.mark.parametrize(("algorithm", "counts"), [(LAGRANGE, (5, 4)), (BICUBIC, (9, 7))])
def test_a_tilted_bed_is_exact_whatever_the_tension(algorithm: str, counts: tuple[int, int]) -> None:
    for tension in (0.0, 0.2, 0.5):
        assert worst(mesh_of(tilted, *counts, algorithm, tension), tilted) < 1e-12


def test_lagrange_follows_what_polynomials_can_be() -> None:
    assert worst(mesh_of(bowed, 5, 5), bowed) < 1e-4
    assert worst(mesh_of(bowed, 3, 3), bowed) > 1e-3, "a cubic needs four points"


def test_bicubic_follows_a_bed_the_closer_the_more_points_it_has() -> None:
    found = [worst(mesh_of(bowed, n, n, BICUBIC, 0.5), bowed) for n in (5, 9, 17)]
    assert found == sorted(found, reverse=True)
    assert found[-1] < 0.002
    assert worst(mesh_of(bowed, 9, 9, BICUBIC, 0.0), bowed) > 2 * found[1], "tension acts"


@pytest.mark.parametrize(("algorithm", "counts"), [(LAGRANGE, (6, 3)), (BICUBIC, (7, 4))])
def test_it_goes_through_all_points_with_continuous_slopes(algorithm: str, counts: tuple[int, int]) -> None:
    rng = np.random.default_rng(1)
    mesh = mesh_of(lambda x, _: rng.normal(0, 0.2, x.shape), *counts, algorithm)
    surface = mesh.surface()
    for (row, column), height in np.ndenumerate(mesh.heights):
        x, y = Grid(FIRST, LAST, counts).point(row, column)
        assert surface.motor_z(x, y, 1.0) == pytest.approx(1.0 + height, abs=1e-12)
    x, width = FIRST[0] + mesh.spacing[0], 1e-5
    before, here, behind = (surface.motor_z(x + step, 77.0, 0.0) for step in (-width, 0.0, width))
    assert here - before == pytest.approx(behind - here, abs=1e-9)
    fine = np.array(mesh.fine_heights())
    assert fine.shape == ((counts[1] - 1) * 3 + 1, (counts[0] - 1) * 3 + 1)
    assert fine[::3, ::3] == pytest.approx(np.array(mesh.heights), abs=1e-12)


def test_fade_and_offsets() -> None:
    mesh = mesh_of(tilted, 3, 3)
    assert Fade(1, 0, None).of(mesh) == (math.inf, math.inf, 0.0)
    assert Fade(1, 11, None).of(mesh) == pytest.approx((1, 11, np.mean(mesh.heights)))
    fade = Fade(1, 11, 0.0).of(mesh, z_offset=0.5)
    assert fade == (0.5, 10.5, 0.0)
    surface = mesh.surface(fade)
    height = tilted(50.0, 60.0)
    assert surface.motor_z(50, 60, 0.5) == pytest.approx(0.5 + height)  # type: ignore[operator]
    assert surface.motor_z(50, 60, 5.5) == pytest.approx(5.5 + height / 2)  # type: ignore[operator]
    assert surface.motor_z(50, 60, 12) == 12
    assert surface.planned_z(50, 60, surface.motor_z(50, 60, 4.0)) == pytest.approx(4.0)
    moved = mesh.surface(offset=(10.0, -5.0))
    assert moved.motor_z(40, 65, 0) == pytest.approx(height)


def test_beyond_the_mesh_its_edge_goes_on() -> None:
    surface = mesh_of(tilted, 3, 3).surface()
    assert surface.motor_z(-50, 300, 0) == pytest.approx(tilted(FIRST[0], LAST[1]))


@pytest.mark.parametrize(
    ("wanted", "counts", "found"),
    [(LAGRANGE, (3, 6), LAGRANGE), (BICUBIC, (4, 9), BICUBIC), (BICUBIC, (3, 6), LAGRANGE)],
)
def test_what_fits_the_number_of_points(wanted: str, counts: tuple[int, int], found: str) -> None:
    assert fitting_algorithm(wanted, counts) == found


@pytest.mark.parametrize(("wanted", "counts"), [(LAGRANGE, (7, 3)), (BICUBIC, (3, 7))])
def test_what_fits_no_algorithm_is_refused(wanted: str, counts: tuple[int, int]) -> None:
    with pytest.raises(ValueError, match="cannot be joined by lagrange"):
        fitting_algorithm(wanted, counts)


# ------------------------------------------------------------------------------------- where it is measured


def test_points_are_probed_to_and_fro() -> None:
    assert Grid((0, 0), (20, 10), (3, 2)).places() == [
        (0, 0),
        (10, 0),
        (20, 0),
        (20, 10),
        (10, 10),
        (0, 10),
    ]


def test_a_round_bed_is_probed_inside_and_filled_outside() -> None:
    grid = Grid((-50, -50), (50, 50), (5, 5), (0, 0), 50)
    places = grid.places()
    assert len(places) == 13
    assert all(math.hypot(*place) <= 50 for place in places)
    heights = grid.heights(lambda place: place[0] + place[1])
    assert heights[0] == (-50,) * 5
    assert heights[1] == (-50, -50, -25, 0, 0)


def test_a_faulty_region_is_measured_around() -> None:
    grid = Grid((0, 0), (40, 40), (5, 5), regions=(Region((5, 5), (12, 14)), Region((35, 35), (60, 60))))
    asked: list[Place] = []

    def height(place: Place) -> float:
        asked.append(place)
        return place[0]

    places = grid.places()
    assert (10, 10) not in places
    assert {(5, 10), (12, 10), (10, 5), (10, 14)} <= set(places)
    heights = grid.heights(height)
    assert set(asked) == set(places)
    assert heights[1][1] == pytest.approx((5 + 12 + 10 + 10) / 4)
    assert heights[4][4] == pytest.approx((35 + 40) / 2), "beyond the mesh nothing is probed"


def test_a_row_without_any_point_is_refused() -> None:
    grid = Grid((0, 0), (20, 20), (3, 3), regions=(Region((-9, -9), (29, 5)), Region((-9, 1), (29, 29))))
    with pytest.raises(ValueError, match="faulty regions cover it"):
        grid.heights(lambda _: 0.0)


def test_an_adaptive_grid_is_as_dense_and_no_larger() -> None:
    grid = Grid((0, 0), (200, 200), (6, 6))
    objects = [[(60.0, 60.0), (100.0, 60.0), (100.0, 90.0)], [(120.0, 80.0)]]
    assert adapted(grid, objects, 5.0) == Grid((55, 55), (125, 95), (3, 3))
    assert adapted(grid, [], 5.0) == grid
    assert adapted(grid, [[(-50.0, -50.0), (300.0, 300.0)]], 5.0) == grid
    assert adapted(grid, [[(300.0, 300.0)]], 5.0) == grid
    dense = Grid((0, 0), (200, 200), (20, 20))
    assert adapted(dense, [[(0.0, 90.0), (200.0, 100.0)]], 0.0).counts == (20, 4), "enough for bicubic"
