"""One node's clock relative to another's, from pairs of simultaneous readings. Sans-IO.

A sync pulse is one CAN frame: every node latches its clock when the frame has ended, which happens everywhere
on a bus within a bit time. The latency of the receive interrupts differs: usually by a fraction of a
microsecond, sometimes by much more, on either side. So the difference of the two clocks is fitted by a
parabola (crystals warm up at different rates), and readings are weighted less the further off and the older
they are.
"""

import math
from collections import deque
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from operator import mul
from typing import Final

from nodes.clock.clock import Ticks
from nodes.support.linear import solve

FADE_S: Final = 8.0
"""Chosen with simulated ramps of 20 ppm in 600 s: a shorter time follows their start faster, a longer one
has less noise."""
PAIRS_MAX: Final = 64
SETTLE_PAIRS: Final = 24
SETTLE_S: Final = 1.0
"""The rate is known to about 0.2 ppm after so many pairs over so long."""
BEND_S: Final = 6.0
"""Seconds ahead for which a curvature is extrapolated at most."""
JITTER_FLOOR_S: Final = 0.3e-6
"""Least standard deviation of a reading: about the jitter of receive interrupts on an idle chip."""
RATE_PRIOR: Final = 1e-3
CURVATURE_PRIOR_PER_S: Final = 1e-7
"""Standard deviations for two crystals before anything is measured."""
ROBUST: Final = 3.0
"""Readings further off than so many standard deviations lose weight with the square of that."""
ROUNDS: Final = 4
JUMP_S: Final = 1e-3
"""No two crystals diverge by so much between two pulses: one of the nodes restarted."""
REACH_S: Final = 1.5
"""How far beyond the last pair the error bound holds: as far as steps are generated ahead."""
CONFIDENCE: Final = 3.0


@dataclass(frozen=True, slots=True)
class PulseLine:
    """A node's clock as a function of the reference node's; immutable, so that any thread may use it."""

    reference: Ticks
    ticks: Ticks
    """The two clocks at the last pulse, as they were latched."""
    reference_hz: int
    freq_hz: int
    offset_s: float
    """Deviation of the latched pair from the fit."""
    rate: float
    """By how much the node's clock is faster, relative to nominal: 1e-6 is 1 ppm."""
    curvature_per_s: float
    error_s: float
    """Bound of the error up to REACH_S ahead of the last pulse, interrupt latency included."""

    def ticks_at(self, reference: Ticks) -> Ticks:
        """Return the node's clock when the reference's shows REFERENCE."""
        t = (reference - self.reference) / self.reference_hz
        return Ticks(self.ticks + round((t + self._parting_s(t)) * self.freq_hz))

    def reference_at(self, ticks: Ticks) -> Ticks:
        """Return the reference's clock when the node's shows TICKS."""
        passed = (ticks - self.ticks) / self.freq_hz
        t = passed
        for _ in range(3):  # each iteration gains at least three digits: rates differ by less than RATE_PRIOR
            t = passed - self._parting_s(t)
        return Ticks(self.reference + round(t * self.reference_hz))

    def _parting_s(self, t: float) -> float:
        """Return by how much more than T the node's clock has moved T s after the last pulse."""
        bend_s = min(t, BEND_S)
        return self.offset_s + self.rate * t + self.curvature_per_s * bend_s * bend_s / 2


def _noise(off_s: Sequence[float]) -> float:
    """Return the median deviation of readings, scaled to the standard deviation of a normal distribution."""
    ranked, half = sorted(off_s), len(off_s) // 2
    return max(JITTER_FLOOR_S, 1.4826 * (ranked[half] + ranked[~half]) / 2)


class PulseFit:
    """Fits the clock of a node (FREQ_HZ nominal) to the reference node's (REFERENCE_HZ nominal)."""

    def __init__(self, reference_hz: int, freq_hz: int) -> None:
        self._reference_hz = reference_hz
        self._freq_hz = freq_hz
        self._pairs: deque[tuple[Ticks, Ticks]] = deque(maxlen=PAIRS_MAX)
        self._off_s: list[float]
        """Deviation of the pairs from the newest fit."""
        self.line: PulseLine | None = None
        """The newest fit; None before the first pair."""
        self.restarts = 0
        """Number of restarts of the fit after a jump of either clock."""

    @property
    def settled(self) -> bool:
        """Whether there are enough pairs, over a sufficient time."""
        if len(self._pairs) < SETTLE_PAIRS:
            return False
        return (self._pairs[-1][0] - self._pairs[0][0]) / self._reference_hz >= SETTLE_S

    def add(self, reference: Ticks, ticks: Ticks) -> None:
        """Add a pair of clocks latched together; pairs come in order."""
        if self.line is not None and self._jumped(self.line, reference, ticks):
            self._pairs.clear()
            self.restarts += 1
        self._pairs.append((reference, ticks))
        self.line = self._fit(self._off_the_last_line())

    def fill(self, pairs: Iterable[tuple[Ticks, Ticks]]) -> None:
        """Start again with PAIRS, in order; pairs before a jump of either clock do not count."""
        self._pairs.clear()
        for pair in pairs:
            if self._pairs and self._parted(self._pairs[-1], pair):
                self._pairs.clear()
            self._pairs.append(pair)
        self.line = self._fit([0.0] * len(self._pairs)) if self._pairs else None

    def _parted(self, earlier: tuple[Ticks, Ticks], later: tuple[Ticks, Ticks]) -> bool:
        passed_s = (later[0] - earlier[0]) / self._reference_hz
        off_s = abs((later[1] - earlier[1]) / self._freq_hz - passed_s)
        return passed_s <= 0 or off_s > JUMP_S + RATE_PRIOR * passed_s

    def _jumped(self, line: PulseLine, reference: Ticks, ticks: Ticks) -> bool:
        passed_s = (reference - line.reference) / self._reference_hz
        off_s = abs(ticks - line.ticks_at(reference)) / self._freq_hz
        return passed_s <= 0 or off_s > JUMP_S + RATE_PRIOR * passed_s

    def _fit(self, off_s: list[float]) -> PulseLine:
        """Fit the pairs, whose known deviations are OFF_S."""
        last_reference, last_ticks = self._pairs[-1]
        times = [(reference - last_reference) / self._reference_hz for reference, _ in self._pairs]
        partings = [
            (ticks - last_ticks) / self._freq_hz - t for (_, ticks), t in zip(self._pairs, times, strict=True)
        ]
        readings = [(t, t * t / 2, y, math.exp(t / FADE_S)) for t, y in zip(times, partings, strict=True)]
        noise_s = _noise(off_s)
        for _ in range(ROUNDS):
            normal, fitted = _weighted_parabola(readings, off_s, noise_s)
            offset_s, rate, curvature_per_s = fitted
            off_s = [abs(y - offset_s - rate * t - curvature_per_s * bend) for t, bend, y, _ in readings]
            noise_s = _noise(off_s)
        self._off_s = off_s
        ahead = (1.0, REACH_S, REACH_S**2 / 2)
        variance = sum(map(mul, ahead, solve(normal, ahead)))
        return PulseLine(
            last_reference,
            last_ticks,
            self._reference_hz,
            self._freq_hz,
            offset_s,
            rate,
            curvature_per_s,
            CONFIDENCE * math.sqrt(variance) + noise_s,
        )

    def _off_the_last_line(self) -> list[float]:
        """Return the deviation of pairs from the last fit, so that a late latch cannot bend the new one."""
        line, count = self.line, len(self._pairs)
        if line is None or count < SETTLE_PAIRS:
            return [0.0] * count
        reference, ticks = self._pairs[-1]
        newest_s = abs(ticks - line.ticks_at(reference)) / self._freq_hz
        return [*self._off_s, newest_s][-count:]


def _weighted_parabola(
    readings: Sequence[tuple[float, float, float, float]], off_s: Sequence[float], noise_s: float
) -> tuple[list[list[float]], list[float]]:
    """Return the matrix of the normal equations of READINGS, and their solution.

    READINGS: time, half its square, value, weight. Those further OFF_S than usual lose weight.
    """
    limit_s = ROBUST * noise_s
    weights = wt = wb = wtt = wtb = wbb = wy = wty = wby = 0.0
    for (t, bend, y, fade), off in zip(readings, off_s, strict=True):
        weight = fade if off <= limit_s else fade * (limit_s / max(off, JITTER_FLOOR_S)) ** 2
        by_t, by_bend = weight * t, weight * bend
        weights, wt, wb, wy = weights + weight, wt + by_t, wb + by_bend, wy + weight * y
        wtt, wtb, wbb = wtt + by_t * t, wtb + by_t * bend, wbb + by_bend * bend
        wty, wby = wty + by_t * y, wby + by_bend * y
    scale = noise_s**-2
    normal = [
        [scale * weights, scale * wt, scale * wb],
        [scale * wt, scale * wtt + RATE_PRIOR**-2, scale * wtb],
        [scale * wb, scale * wtb, scale * wbb + CURVATURE_PRIOR_PER_S**-2],
    ]
    return normal, solve(normal, (scale * wy, scale * wty, scale * wby))
