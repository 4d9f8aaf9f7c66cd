"""The capacity and the sensor's lag that explain how a heater got hot at a constant power.

The model's rise above the ambient, with power P, capacity C, loss rate λ and responsiveness k, is in closed
form  P / (C λ) · (1 - (k e^{-λt} - λ e^{-kt}) / (k - λ)).  The values are found by Gauss and Newton's
method on their logarithms, so that all stay positive.
"""

import math
import operator
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Final

from coordinator.heat.pid_tune import TuneError

MAX_POINTS: Final = 2000
TRIES: Final = 60
ENOUGH: Final = 1e-7
LONGEST_STEP: Final = 0.5
"""Of a logarithm: by how much a try may change a value."""
HIGHEST_LOG: Final = 25.0
MIN_POINTS: Final = 12
SINGULAR: Final = 1e-10
USUAL_LOSS_S: Final = 300.0
"""A heater that is off cools with about this time constant, and a loss is taken as this …"""
PULL_K: Final = 0.01
"""… unless every point of the rise would be so much nearer for each e-fold of difference."""


@dataclass(slots=True)
class Rise:
    """Temperatures measured since the power was switched on; of a long rise every second one is dropped."""

    begin_s: float = 0.0
    points: list[tuple[float, float]] = field(default_factory=list)
    """(s since the begin, °C)."""
    _stride: int = 1
    _count: int = 0

    def add(self, now_s: float, celsius: float) -> None:
        """Take a measurement; the first one is when the power was switched on."""
        if not self.points:
            self.begin_s = now_s
        if self._count % self._stride == 0:
            self.points.append((now_s - self.begin_s, celsius))
        self._count += 1
        if len(self.points) > MAX_POINTS:
            self.points = self.points[::2]
            self._stride *= 2


@dataclass(frozen=True, slots=True)
class Fit:
    """What explains a rise."""

    capacity_j_per_k: float
    responsiveness_per_s: float
    loss_per_s: float
    """Loss over capacity: 1/s."""


def fit_rise(rise: Rise, heat_w: float, ambient_c: float, *, transfer_w_per_k: float | None = None) -> Fit:
    """Return what explains a rise at HEAT_W.

    Where the loss TRANSFER_W_PER_K is not known yet it is found too, as far as the rise shows it. Raises
    TuneError when nothing fits.
    """
    if len(rise.points) < MIN_POINTS:
        raise TuneError("the heater is too fast for its sensor to be measured; choose a higher target")
    pull = PULL_K * math.sqrt(len(rise.points))

    def unpack(logs: Sequence[float]) -> Fit:
        capacity, k = math.exp(logs[0]), math.exp(logs[1])
        return Fit(
            capacity, k, math.exp(logs[2]) if transfer_w_per_k is None else transfer_w_per_k / capacity
        )

    def errors(logs: Sequence[float]) -> list[float]:
        fit = unpack(logs)
        rate, loss, k = heat_w / fit.capacity_j_per_k, fit.loss_per_s, fit.responsiveness_per_s
        found = [ambient_c + risen(rate, loss, k, at) - c for at, c in rise.points]
        return found if transfer_w_per_k is not None else [*found, pull * math.log(loss * USUAL_LOSS_S)]

    span_s = rise.points[-1][0]
    gained = max(rise.points[-1][1] - ambient_c, 1.0)
    logs = [math.log(heat_w * span_s / gained), math.log(10 / span_s)]
    if transfer_w_per_k is None:
        logs.append(-math.log(USUAL_LOSS_S))
    for _ in range(TRIES):
        steps = _newton(errors, logs)
        logs = [value + step for value, step in zip(logs, steps, strict=True)]
        if max(map(abs, logs)) > HIGHEST_LOG:
            break
        if max(map(abs, steps)) < ENOUGH:
            return unpack(logs)
    raise TuneError("the heater's rise looks like that of no heater; check that its sensor is fixed to it")


def risen(rate: float, loss: float, k: float, at_s: float) -> float:
    """Return by how much the sensor has risen AT_S after a heating of RATE (K/s without loss) began."""
    if abs(k - loss) < 1e-9 * k:
        k *= 1 + 1e-6
    fast, slow = -math.expm1(-k * at_s) / k, -math.expm1(-loss * at_s) / loss
    return rate * k * (slow - fast) / (k - loss)


def _newton(errors: Callable[[Sequence[float]], list[float]], at: Sequence[float]) -> list[float]:
    """Return the step towards the least squares, no longer than allowed."""
    small = 1e-5
    here = errors(at)
    slopes = []
    for index in range(len(at)):
        moved = [value + small * (place == index) for place, value in enumerate(at)]
        slopes.append([(there - e) / small for there, e in zip(errors(moved), here, strict=True)])
    normal = [[sum(map(operator.mul, row, column)) for column in slopes] for row in slopes]
    steps = _solve(normal, [-sum(map(operator.mul, row, here)) for row in slopes])
    shorter = LONGEST_STEP / max(LONGEST_STEP, *map(abs, steps))
    return [step * shorter for step in steps]


def _solve(matrix: list[list[float]], right: list[float]) -> list[float]:
    """Solve a symmetric positive system by elimination; TuneError when it is singular."""
    size = len(right)
    rows = [[*row, value] for row, value in zip(matrix, right, strict=True)]
    for pivot in range(size):
        if rows[pivot][pivot] <= SINGULAR * matrix[pivot][pivot]:
            raise TuneError("the heater's rise is too short to tell its capacity from its sensor's lag")
        for below in range(pivot + 1, size):
            factor = rows[below][pivot] / rows[pivot][pivot]
            rows[below] = [x - factor * y for x, y in zip(rows[below], rows[pivot], strict=True)]
    solution = [0.0] * size
    for row in reversed(range(size)):
        known = sum(rows[row][column] * solution[column] for column in range(row + 1, size))
        solution[row] = (rows[row][size] - known) / rows[row][row]
    return solution
