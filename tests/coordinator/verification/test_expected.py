"""The witness against a slower one that samples positions finely."""

import itertools
from typing import Any

import numpy as np
import pytest

from coordinator.verification.exact_signal import TRAPEZOID
from coordinator.verification.expected import Floats, expected_steps


def trapezoid(
    print_time: float,
    start: tuple[float, float, float, float],
    end: tuple[float, float, float, float],
    accel: float,
    cruise_v: float,
) -> Any:
    """Return a move from standstill to standstill."""
    way = np.array(end) - np.array(start)
    length = float(np.linalg.norm(way))
    cruise_v = min(cruise_v, (length * accel) ** 0.5)
    accel_s = cruise_v / accel
    cruise_s = (length - cruise_v * accel_s) / cruise_v
    row = (print_time, accel_s, cruise_s, accel_s, 0.0, cruise_v, accel, start, tuple(way / length), 0.0, 1)
    return np.array([row], dtype=TRAPEZOID)[0]


def distances(move: np.void, times: Floats) -> Floats:
    """Return the distances along MOVE at TIMES, in s after its begin."""
    phases = (
        (move["accel_s"], move["start_v"], move["accel"]),
        (move["cruise_s"], move["cruise_v"], 0.0),
        (move["decel_s"], move["cruise_v"], -move["accel"]),
    )
    way, left = np.zeros(len(times)), times
    for duration, velocity, accel in phases:
        now = np.clip(left, 0.0, duration)
        way += velocity * now + accel * now * now / 2
        left = left - duration
    return way


@pytest.mark.parametrize("weights", [(1, 0, 0, 0), (1, 1, 0, 0), (1, -1, 0, 0), (0, 0, 1, 0)])
def test_agrees_with_fine_sampling(weights: tuple[float, float, float, float]) -> None:
    corners = [(0, 0, 0, 0), (7, 3, 0.2, 0), (7, -2, 0.2, 0), (1.234, 0.5, 0.4, 0), (1.0, 1.0, 0.4, 0)]
    moves = []
    print_time = 100.0
    for start, end in itertools.pairwise(corners):
        move = trapezoid(print_time, start, end, accel=900.0, cruise_v=40.0)
        print_time += float(move["accel_s"] + move["cruise_s"] + move["decel_s"])
        moves.append(move)
    step = 0.05
    seen_times, seen_directions = [], []
    standing = 0
    for move in moves:
        duration = float(move["accel_s"] + move["cruise_s"] + move["decel_s"])
        times = np.linspace(0, duration, 20_000)
        points = move["start"] + np.outer(distances(move, times), move["ratio"])
        steps = np.floor(points @ np.array(weights) / step + 0.5).astype(int)
        changes = np.diff(steps, prepend=standing)
        changed = changes != 0
        assert (abs(changes[changed]) == 1).all()
        seen_times.extend(float(move["print_time"]) + times[changed])
        seen_directions.extend(changes[changed].tolist())
        standing = int(steps[-1])
    chunks = list(expected_steps(np.array(moves, dtype=TRAPEZOID), weights, step, origin=0.0))
    times = np.concatenate([c.print_time for c in chunks])
    directions = np.concatenate([c.direction for c in chunks])
    assert directions.tolist() == seen_directions
    assert np.abs(times - np.array(seen_times)).max() < 1e-4
    assert np.all(np.diff(times) > 0)
