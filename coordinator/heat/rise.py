"""The capacity and the sensor's lag that explain how a heater got hot at a constant power.

The model's rise above the ambient, with power P, capacity C, loss rate λ and responsiveness k, is in closed
form  P / (C λ) · (1 - (k e^{-λt} - λ e^{-kt}) / (k - λ)).  C and k are found by Gauss and Newton's method on
their logarithms, so that both stay positive.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Final

from coordinator.heat.pid_tune import TuneError

MAX_POINTS: Final = 2000
TRIES: Final = 60
ENOUGH: Final = 1e-7
LONGEST_STEP: Final = 0.5
"""Of a logarithm: by how much a try may change a value."""
MIN_POINTS: Final = 12


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


def fit_rise(
    rise: Rise,
    heat_w: float,
    ambient_c: float,
    *,
    transfer_w_per_k: float | None = None,
    loss_per_s: float = 0.0,
) -> tuple[float, float]:
    """Return capacity (J/K) and responsiveness (1/s) for a rise at HEAT_W.

    The loss is TRANSFER_W_PER_K, or where that is not known yet LOSS_PER_S times the capacity. Raises
    TuneError when nothing fits.
    """
    if len(rise.points) < MIN_POINTS:
        raise TuneError("the heater is too fast for its sensor to be measured; choose a higher target")

    def errors(log_capacity: float, log_k: float) -> list[float]:
        capacity, k = math.exp(log_capacity), math.exp(log_k)
        loss = loss_per_s if transfer_w_per_k is None else transfer_w_per_k / capacity
        return [ambient_c + risen(heat_w / capacity, loss, k, at) - c for at, c in rise.points]

    span_s = rise.points[-1][0]
    gained = max(rise.points[-1][1] - ambient_c, 1.0)
    x, y = math.log(heat_w * span_s / gained), math.log(10 / span_s)
    for _ in range(TRIES):
        dx, dy = _newton(errors, x, y)
        x, y = x + dx, y + dy
        if abs(dx) + abs(dy) < ENOUGH:
            return math.exp(x), math.exp(y)
    raise TuneError("the heater's rise looks like that of no heater; check that its sensor is fixed to it")


def risen(rate: float, loss: float, k: float, at_s: float) -> float:
    """Return by how much the sensor has risen AT_S after a heating of RATE (K/s without loss) began."""
    if abs(k - loss) < 1e-9 * k:
        k *= 1 + 1e-6
    fast, slow = -math.expm1(-k * at_s) / k, -math.expm1(-loss * at_s) / loss if loss > 0 else at_s
    return rate * k * (slow - fast) / (k - loss)


def _newton(errors: Callable[[float, float], list[float]], x: float, y: float) -> tuple[float, float]:
    """Return the step towards the least squares, no longer than allowed."""
    small = 1e-5
    here = errors(x, y)
    by_x = [(there - e) / small for there, e in zip(errors(x + small, y), here, strict=True)]
    by_y = [(there - e) / small for there, e in zip(errors(x, y + small), here, strict=True)]
    xx = sum(v * v for v in by_x)
    yy = sum(v * v for v in by_y)
    xy = sum(v * w for v, w in zip(by_x, by_y, strict=True))
    ex = sum(v * e for v, e in zip(by_x, here, strict=True))
    ey = sum(v * e for v, e in zip(by_y, here, strict=True))
    determinant = xx * yy - xy * xy
    if determinant <= 1e-12 * xx * yy:
        raise TuneError("the heater's rise is too short to tell its capacity from its sensor's lag")
    dx, dy = (xy * ey - yy * ex) / determinant, (xy * ex - xx * ey) / determinant
    longest = max(abs(dx), abs(dy), LONGEST_STEP)
    return dx * LONGEST_STEP / longest, dy * LONGEST_STEP / longest
