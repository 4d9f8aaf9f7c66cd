"""When a stepper has to step that is shaped, smoothed or moved by a non-linear kinematics.

As ``expected.py``, nothing of the engine: the motion from its definition (``exact_path.py``), cut where it
turns, and every boundary between two turns solved for its time.
"""

from collections.abc import Iterator, Sequence

import numpy as np

from coordinator.verification.exact_path import Ints, Leg, StepperPath, crossing_times, follow
from coordinator.verification.exact_signal import Floats
from coordinator.verification.expected import ExpectedSteps

CHUNK = 50_000
"""Steps solved together."""
SLACK_TICKS = 2.5
"""By so much more than its pulses need a pair of opposite steps may be apart and still be left out."""


def expected_curved(legs: Sequence[Leg], clock_freq: float) -> Iterator[ExpectedSteps]:
    """Yield the steps that LEGS ask of their stepper, in order."""
    for path, turns, u, place in follow(legs):
        closest_s = 2 * path.spec.step_pulse_s + SLACK_TICKS / clock_freq
        times, directions = _steps(path, turns, u, place)
        keep = _without_pairs(times, directions, closest_s)
        yield ExpectedSteps(times[keep], directions[keep].astype(np.int8))


def _steps(path: StepperPath, turns: Floats, u: Floats, place: Ints) -> tuple[Floats, Ints]:
    """Return times and directions of the steps of PATH, given its places."""
    change = np.diff(place)
    count = np.abs(change).astype(np.intp)  # on 32 bits, repeat() takes no longer numbers
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
