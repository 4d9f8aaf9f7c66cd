"""When a stepper has to step that is shaped, smoothed or moved by a non-linear kinematics.

As ``expected.py``, nothing of the engine: the motion from its definition (``exact_path.py``), cut where it
turns, and every boundary between two turns solved for its time.
"""

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from coordinator.demo.exact_path import Ints, Setting, StepperPath, crossing_times, places
from coordinator.demo.exact_signal import Floats
from coordinator.demo.expected import ExpectedSteps
from coordinator.motion.specs import StepperSpec

CHUNK = 50_000
"""Steps solved together."""
SLACK_TICKS = 2.5
"""By so much more than its pulses need a pair of opposite steps may be apart and still be left out."""

Epoch = tuple[tuple[float, float, float, float], NDArray[np.void]]


def expected_curved(
    spec: StepperSpec, epochs: Sequence[Epoch], setting: Setting, clock_freq: float
) -> Iterator[ExpectedSteps]:
    """Yield the steps that the moves of EPOCHS (PlanRecord) ask of one stepper, in order."""
    closest_s = 2 * spec.step_pulse_s + SLACK_TICKS / clock_freq
    position = 0
    for start, moves in epochs:
        if not len(moves):
            continue
        path = StepperPath(spec, start, moves, setting, position)
        times, directions = _steps(path)
        position += int(directions.sum())
        keep = _without_pairs(times, directions, closest_s)
        yield ExpectedSteps(times[keep], directions[keep].astype(np.int8))


def _steps(path: StepperPath) -> tuple[Floats, Ints]:
    turns, u, place = places(path)
    change = np.diff(place).astype(np.int64)
    count = np.abs(change)
    which = np.repeat(np.arange(len(count)), count)
    nth = np.arange(len(which)) - np.repeat(np.cumsum(count) - count, count)
    direction = np.sign(change)[which]
    boundary = place[:-1][which] + direction * (nth + 0.5)
    times = np.empty(len(which))
    for at in range(0, len(which), CHUNK):
        some = slice(at, at + CHUNK)
        low, high = turns[which[some]], turns[which[some] + 1]
        found = crossing_times(path, boundary[some], direction[some], low, high)
        # A boundary that only rounding put between the turns is crossed at one of them.
        nearer = np.where(direction[some] * (u[which[some]] - boundary[some]) > 0, low, high)
        times[some] = np.where(np.isnan(found), nearer, found)
    return times, direction


def _without_pairs(times: Floats, directions: Ints, closest_s: float) -> Ints:
    """Return which steps are done: two opposite ones closer than the pulses allow cancel out."""
    kept: list[int] = []
    close = np.flatnonzero((directions[1:] != directions[:-1]) & (np.diff(times) < closest_s))
    if not len(close):
        return np.arange(len(times))
    for i in range(len(times)):
        if kept and directions[kept[-1]] != directions[i] and times[i] - times[kept[-1]] < closest_s:
            kept.pop()
        else:
            kept.append(i)
    return np.array(kept, np.int64)
