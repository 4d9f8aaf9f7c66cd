"""Corners of the path: all while they fit, those that matter when they do not."""

import itertools
from copy import deepcopy

import numpy as np
import pytest

from coordinator.motion.trapezoid_array import TRAPEZOID
from coordinator.service.state.toolpath import KEEP_SHARE, Corners, Toolpath


def straight(*corners: tuple[float, float, float], extrudes: bool = True, from_s: float = 0.0) -> bytes:
    """Return moves of one second each between CORNERS, at constant speed."""
    moves = np.zeros(len(corners) - 1, TRAPEZOID)
    for i, (a, b) in enumerate(itertools.pairwise(corners)):
        way = np.subtract(b, a)
        length = float(np.linalg.norm(way))
        moves[i]["print_time"], moves[i]["cruise_s"], moves[i]["cruise_v"] = from_s + i, 1.0, length
        moves[i]["start_v"] = length
        moves[i]["start"] = (*a, 0.0)
        moves[i]["ratio"] = (*(way / length if length else way), 0.5 if extrudes else 0.0)
    return moves.tobytes()


def places(path: Toolpath) -> list[tuple[float, ...]]:
    corners = path.after(0, len(path))
    return list(zip(corners.x, corners.y, corners.z, strict=True))


def test_corners_times_and_travels_in_order() -> None:
    path = Toolpath()
    path.add(straight((0, 0, 0), (10, 0, 0), (10, 5, 0), extrudes=False))
    path.add(straight((10, 5, 0), (10, 5, 2), from_s=2.0))
    assert places(path) == [(0, 0, 0), (10, 0, 0), (10, 5, 0), (10, 5, 2)]
    corners = path.after(0, 10)
    assert corners.time_s == [0, 1, 2, 3]
    assert corners.extrudes == [False, False, False, True]
    assert path.after(2, 1) == Corners([10], [5], [0], [2], [False])
    assert path.after(4, 10) == path.after(9, 1) == Corners([], [], [], [], [])


def test_places_are_rounded() -> None:
    path = Toolpath()
    path.add(straight((0, 0, 0), (1.23456, -0.00049, 7.0006), from_s=1000.00049))
    corners = path.after(1, 1)
    assert (corners.x, corners.y, corners.z, corners.time_s) == ([1.235], [0.0], [7.001], [1001.0])


def test_acceleration_counts_into_the_length() -> None:
    moves = np.zeros(1, TRAPEZOID)
    moves["accel_s"], moves["cruise_s"], moves["decel_s"] = 2.0, 3.0, 1.0
    moves["accel"], moves["start_v"], moves["cruise_v"] = 10.0, 0.0, 20.0
    moves["ratio"][0] = (1.0, 0.0, 0.0, 0.0)
    path = Toolpath()
    path.add(moves.tobytes())
    assert places(path)[-1] == pytest.approx((20 + 60 + 15, 0, 0))  # it ends at 10 mm/s


def test_what_does_not_move_the_tool_is_no_corner() -> None:
    path = Toolpath()
    path.add(straight((0, 0, 0), (1, 0, 0), (1, 0, 0), (2, 0, 0)))
    assert places(path) == [(0, 0, 0), (1, 0, 0), (2, 0, 0)]


def test_a_jump_is_a_way_without_extrusion() -> None:
    path = Toolpath()
    path.add(straight((0, 0, 0), (1, 0, 0)))
    path.add(straight((50, 0, 0), (51, 0, 0), from_s=5.0))
    assert places(path) == [(0, 0, 0), (1, 0, 0), (50, 0, 0), (51, 0, 0)]
    assert path.after(0, 4).extrudes == [False, True, False, True]


def test_what_was_given_out_stays_while_the_path_grows() -> None:
    path = Toolpath()
    path.add(straight((0, 0, 0), (1, 0, 0)))
    given = path.after(0, 10)
    copies = deepcopy(given)
    for x in range(1, 100):
        path.add(straight((x, 0, 0), (x + 1, 0, 0), from_s=x))
    assert given == copies
    assert places(path) == [(x, 0, 0) for x in range(101)]
    assert path.after(0, 200).time_s == list(range(101))


def test_a_new_generation_for_all_that_changes_numbers() -> None:
    path, other = Toolpath(), Toolpath()
    assert path.generation != other.generation
    before = path.generation
    path.add(straight((0, 0, 0), (1, 0, 0)))
    assert path.generation == before
    path.clear()
    assert len(path) == 0
    assert path.generation not in (before, other.generation)


def test_when_it_is_full_straight_ways_go_before_corners() -> None:
    path = Toolpath(points_max=1000)
    square = [(0.0, 0.0), (100.0, 0.0), (100.0, 100.0), (0.0, 100.0)]
    corners: list[tuple[float, float, float]] = [(0.0, 0.0, 0.0)]
    for layer in range(20):  # sides in 20 pieces: 1600 points, of which 80 are corners
        for (ax, ay), (bx, by) in zip(square, square[1:] + square[:1], strict=True):
            for k in range(1, 21):
                share = k / 20
                corners.append((ax + (bx - ax) * share, ay + (by - ay) * share, 0.2 * layer))
    before = path.generation
    for i in range(0, len(corners) - 1, 100):
        path.add(straight(*corners[i : i + 101], from_s=float(i)))
    assert KEEP_SHARE * 1000 - 1 <= len(path) <= 1000
    assert path.generation != before
    kept = set(places(path))
    wanted = {(x, y, round(0.2 * layer, 9)) for layer in range(1, 20) for x, y in square}
    assert wanted <= {(x, y, round(z, 9)) for x, y, z in kept}
    times = path.after(0, len(path)).time_s
    assert (np.diff(times) > 0).all()


def test_when_every_corner_matters_the_oldest_go() -> None:
    path = Toolpath(points_max=100)
    for i in range(200):  # travel and extrusion in turn: no point may go without the other
        a, b = (float(i), float(i % 2), 0.0), (float(i + 1), float((i + 1) % 2), 0.0)
        path.add(straight(a, b, extrudes=i % 2 == 0, from_s=float(i)))
        assert len(path) <= 100
    assert places(path)[-1] == (200.0, 0.0, 0.0)
