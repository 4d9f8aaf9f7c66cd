"""Positions of the axes as functions of print time, straight from the definitions; nothing of the engine.

A ``Signal`` is piecewise quadratic. Input shaping is a sum of shifted signals; smoothing with a triangular
window is the second difference of the signal's second antiderivative (``Smoothed``).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
TRAPEZOID = np.dtype(
    [
        (name, np.float64)
        for name in ("print_time", "accel_s", "cruise_s", "decel_s", "start_v", "cruise_v", "accel")
    ]
    + [
        ("start", np.float64, 4),
        ("ratio", np.float64, 4),
        ("pressure_advance", np.float64),
        ("line", np.int64),
    ]
)
"""struct trapezoid of trapezoid.h, member by member."""
LONG_AGO_S = -1e6
"""Begin of the rest before the first move; no time asked for lies before it."""
REST_S = -1e3
"""A time within that rest, whatever the delays."""
BLOCK_S = 0.25
"""Antiderivatives are taken over segments this long: their rounding grows with the square of it."""


@dataclass(frozen=True)
class Phases:
    """Motion of all axes in pieces of constant acceleration; the last piece has no end."""

    time: Floats
    """s, begin of each; not falling. Pieces may last 0 s."""
    position: Floats
    """mm, [piece, X Y Z E] at its begin."""
    speed: Floats
    accel: Floats
    advance: Floats
    """s, pressure advance of each."""

    @classmethod
    def of(cls, start: Sequence[float], moves: NDArray[np.void]) -> "Phases":
        """Return the motion that begins at rest at START and makes MOVES (struct trapezoid)."""
        ta, tc, td = (moves[name] for name in ("accel_s", "cruise_s", "decel_s"))
        v0, v, a, zero = moves["start_v"], moves["cruise_v"], moves["accel"], np.zeros(len(moves))
        s1 = v0 * ta + a * ta * ta / 2
        s2 = s1 + v * tc
        s3 = s2 + v * td - a * td * td / 2
        t0 = moves["print_time"]
        columns = [
            ((t0, t0 + ta, t0 + ta + tc, t0 + ta + tc + td)),
            (zero, s1, s2, s3),
            (v0, v, v, zero),
            (a, zero, -a, zero),
        ]
        time, way, speed, accel = (np.stack(column, axis=1).reshape(-1) for column in columns)
        ratio = np.repeat(moves["ratio"], 4, axis=0)
        position = np.repeat(moves["start"], 4, axis=0) + ratio * way[:, None]
        nought = np.zeros((1, 4))
        return cls(
            np.maximum.accumulate(np.concatenate(([LONG_AGO_S], time))),
            np.concatenate((np.array([start], np.float64), position)),
            np.concatenate((nought, ratio * speed[:, None])),
            np.concatenate((nought, ratio * accel[:, None])),
            np.concatenate(([0.0], np.repeat(moves["pressure_advance"], 4))),
        )

    def mix(self, weights: Sequence[float]) -> "Signal":
        """Return the weighted sum of the axes."""
        w = np.array(weights)
        return Signal(self.time, self.position @ w, self.speed @ w, self.accel @ w)

    def advanced(self) -> "Signal":
        """Return E plus pressure advance times its speed; not continuous."""
        p, v, a = self.position[:, 3], self.speed[:, 3], self.accel[:, 3]
        return Signal(self.time, p + self.advance * v, v + self.advance * a, a)


@dataclass(frozen=True)
class Signal:
    """value + speed·τ + accel·τ²/2 from the begin of each piece."""

    time: Floats
    value: Floats
    speed: Floats
    accel: Floats

    def at(self, t: Floats) -> Floats:
        """Return the value at the times T."""
        i = np.searchsorted(self.time, t, side="right") - 1
        tau = t - self.time[i]
        result: Floats = self.value[i] + (self.speed[i] + self.accel[i] / 2 * tau) * tau
        return result

    def slope(self, t: Floats) -> Floats:
        """Return the rate of change at the times T."""
        i = np.searchsorted(self.time, t, side="right") - 1
        result: Floats = self.speed[i] + self.accel[i] * (t - self.time[i])
        return result

    def breaks(self) -> Floats:
        """Return the times between which it is smooth."""
        return self.time[1:]

    def scaled(self, factor: float) -> "Signal":
        """Return it times FACTOR."""
        return Signal(self.time, factor * self.value, factor * self.speed, factor * self.accel)


@dataclass(frozen=True)
class Shaped:
    """Sum of amplitude·signal(t - delay)."""

    signal: Signal
    impulses: tuple[tuple[float, float], ...]

    def at(self, t: Floats) -> Floats:
        """Return the value at the times T."""
        total = np.zeros_like(t)
        for amplitude, delay in self.impulses:
            total += amplitude * self.signal.at(t - delay)
        return total

    def slope(self, t: Floats) -> Floats:
        """Return the rate of change at the times T."""
        total = np.zeros_like(t)
        for amplitude, delay in self.impulses:
            total += amplitude * self.signal.slope(t - delay)
        return total

    def breaks(self) -> Floats:
        """Return the times between which it is smooth."""
        return np.concatenate([self.signal.breaks() + delay for _, delay in self.impulses])


@dataclass(frozen=True)
class Smoothed:
    """The signal averaged over a triangular window of full width 2·HALF_S."""

    signal: Signal
    half_s: float

    def at(self, t: Floats) -> Floats:
        """Return the value at the times T."""
        return self._blocks(t, order=2)

    def slope(self, t: Floats) -> Floats:
        """Return the rate of change at the times T."""
        return self._blocks(t, order=1)

    def breaks(self) -> Floats:
        """Return the times between which it is smooth."""
        return np.concatenate([self.signal.breaks() + shift for shift in (-self.half_s, 0.0, self.half_s)])

    def _blocks(self, t: Floats, order: int) -> Floats:
        """Return the second difference of antiderivative number ORDER, over half_s²; T need not be sorted."""
        result = np.empty_like(t)
        block = np.floor(t / BLOCK_S).astype(np.int64)
        by_block = np.argsort(block, kind="stable")
        cuts = np.flatnonzero(np.diff(block[by_block])) + 1
        for mine in np.split(by_block, cuts):
            if len(mine):
                result[mine] = self._window(t[mine], order)
        return result

    def _window(self, t: Floats, order: int) -> Floats:
        h, begin, end = self.half_s, t.min() - self.half_s, t.max() + self.half_s
        s = self.signal
        i0, i1 = np.searchsorted(s.time, (begin, end), side="right") - (1, 0)
        time = s.time[i0:i1] - begin
        value, speed, accel = s.value[i0:i1].copy(), s.speed[i0:i1].copy(), s.accel[i0:i1]
        # The first piece began earlier: look at it from BEGIN on.
        value[0] -= (speed[0] - accel[0] / 2 * time[0]) * time[0]
        speed[0] -= accel[0] * time[0]
        time = time.copy()
        time[0] = 0.0
        base = value[0]
        pieces = _Antiderivatives(time, value - base, speed, accel)
        t = t - begin
        difference = pieces.at(t + h, order) - 2 * pieces.at(t, order) + pieces.at(t - h, order)
        return difference / (h * h) + (base if order == 2 else 0.0)


class _Antiderivatives:
    """First and second antiderivative of a piecewise quadratic, both 0 at the begin of its first piece."""

    def __init__(self, time: Floats, value: Floats, speed: Floats, accel: Floats) -> None:
        self.time, self.value, self.speed, self.accel = time, value, speed, accel
        d = np.diff(time)
        v, s, a = value[:-1], speed[:-1], accel[:-1]
        self.first = np.concatenate(([0.0], np.cumsum(v * d + s * d**2 / 2 + a * d**3 / 6)))
        second = self.first[:-1] * d + v * d**2 / 2 + s * d**3 / 6 + a * d**4 / 24
        self.second = np.concatenate(([0.0], np.cumsum(second)))

    def at(self, t: Floats, order: int) -> Floats:
        """Return the value at the times T."""
        i = np.searchsorted(self.time, t, side="right") - 1
        np.maximum(i, 0, out=i)
        d = t - self.time[i]
        v, s, a = self.value[i], self.speed[i], self.accel[i]
        result: Floats
        if order == 1:
            result = self.first[i] + (v + (s / 2 + a / 6 * d) * d) * d
        else:
            result = self.second[i] + (self.first[i] + (v / 2 + (s / 6 + a / 24 * d) * d) * d) * d
        return result
