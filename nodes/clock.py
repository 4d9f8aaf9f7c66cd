"""Time between the host and a node: the types, and the estimate of a node's clock from its answers.

Sans-IO: samples come in with their times, an estimate and the time of the next sample go out. Host time
is CLOCK_MONOTONIC in integer nanoseconds; a node's ticks have 64 bits in the host and 32 on the wire.

How it estimates. An answer sent for at S and received at R was read somewhere in between. The fastest
exchange shows what cannot be avoided; what an exchange took longer, its excess X, was lost in one
direction or the other, we cannot know which: the reading is spread evenly over X around the middle,
variance X²/12. So every sample counts with the weight that its own excess earns it. A slow exchange
weighs almost nothing but is never thrown away, and therefore no series of bad samples, the very first
included, can lock the estimate out. A parabola is fitted, because a crystal that warms up changes its
rate, with weights that fade over FADE_S; rate and curvature are held by what is known of crystals before
there are samples enough.
"""

import math
from collections import deque
from dataclasses import dataclass
from typing import Final, NewType

HostTime = NewType("HostTime", int)
"""Nanoseconds of the host's CLOCK_MONOTONIC."""
Ticks = NewType("Ticks", int)
"""A node's clock in 64 bits."""

BURST_SAMPLES: Final = 16
BURST_INTERVAL_NS: Final = 25_000_000
SETTLE_SAMPLES: Final = 48
SETTLE_INTERVAL_NS: Final = 50_000_000
"""After the burst, up to SETTLE_SAMPLES: two seconds after the start the rate is known to some 10 ppm."""
SAMPLE_INTERVAL_NS: Final = 984_300_000
"""Not a divisor or multiple of a second: periodic work on a node must not meet every sample."""
MAX_SAMPLES: Final = 160
"""The oldest are dropped; at one a second they have faded by then."""

FADE_S: Final = 90.0
RATE_PRIOR: Final = 1e-3
"""Standard deviation of a clock's rate against its nominal one, before anything is measured."""
CURVATURE_PRIOR_PER_S: Final = 1.5e-8
"""Standard deviation of a rate's change per second: a crystal in a warming board."""
READING_FLOOR_S: Final = 10e-6
"""No reading is trusted better than this: threads wake up late by as much, on either side. A lower floor lets
one lucky exchange outweigh all others and bend the rate of a young estimate."""
CONFIDENCE: Final = 3.0
"""Standard deviations in the published error bound."""
_HALF: Final = 1 << 31
_WHOLE: Final = 1 << 32


def ticks_since(later: int, earlier: int) -> int:
    """Return LATER - EARLIER for two 32-bit clocks less than 2^31 ticks apart: -2^31..2^31-1."""
    return (later - earlier + _HALF) % _WHOLE - _HALF


def extend32(clock32: int, near: Ticks) -> Ticks:
    """Return the 64-bit clock whose low bits are CLOCK32 and that is nearest to NEAR."""
    return Ticks(near + ticks_since(clock32, near % _WHOLE))


@dataclass(frozen=True, slots=True)
class ClockEstimate:
    """A node's clock as a line through one point; good for extrapolation over a few seconds."""

    freq_hz: float
    at_ns: HostTime
    at_ticks: Ticks
    error_s: float
    """Bound of the error at AT_NS: what the fastest exchange leaves open, and three standard deviations."""

    def ticks_at(self, at_ns: HostTime) -> Ticks:
        """Return the node's clock at host time AT_NS."""
        return Ticks(self.at_ticks + round((at_ns - self.at_ns) * (self.freq_hz * 1e-9)))

    def ns_at(self, ticks: Ticks) -> HostTime:
        """Return the host time at which the node's clock shows TICKS."""
        return HostTime(self.at_ns + round((ticks - self.at_ticks) * 1e9 / self.freq_hz))


@dataclass(frozen=True, slots=True)
class _Sample:
    middle_ns: int
    round_trip_s: float
    ticks: Ticks


class ClockEstimator:
    """Estimates one node's clock. NOMINAL_FREQ_HZ > 0 comes from its dictionary.

    ``begin`` with the answer to get_uptime, then ``add`` for every answer to get_clock.
    """

    def __init__(self, nominal_freq_hz: int) -> None:
        self._freq_hz = nominal_freq_hz
        self._samples: deque[_Sample] = deque(maxlen=MAX_SAMPLES)
        self._estimate: ClockEstimate | None = None
        self.accepted = 0
        self.unusable = 0
        """Answers whose times are not known (a repeated block) or make no sense."""

    @property
    def ready(self) -> bool:
        """Whether there are samples enough to plan with: what is planned looks two seconds ahead."""
        return self.accepted >= SETTLE_SAMPLES

    @property
    def round_trip_s(self) -> float:
        """The fastest exchange remembered; 0 before the first."""
        return min((sample.round_trip_s for sample in self._samples), default=0.0)

    def begin(self, sent_ns: int, received_ns: int, high: int, clock32: int) -> bool:
        """Start, or start anew, with an answer to get_uptime. Returns whether it was usable."""
        self._samples.clear()
        self._estimate = None
        self.accepted = 0
        return self._take(sent_ns, received_ns, Ticks(high * _WHOLE + clock32 % _WHOLE))

    def add(self, sent_ns: int, received_ns: int, clock32: int) -> bool:
        """Take an answer to get_clock: SENT_NS 0 means unknown. Returns whether it was usable."""
        middle_ns = HostTime((sent_ns + received_ns) // 2)
        return self._take(sent_ns, received_ns, extend32(clock32, self.estimate().ticks_at(middle_ns)))

    def estimate(self) -> ClockEstimate:
        """Return the estimate as of the last sample; RuntimeError before ``begin``."""
        if self._estimate is None:
            raise RuntimeError("the clock was asked before its first sample")
        return self._estimate

    def ticks_at(self, at_ns: HostTime) -> Ticks:
        """Return the node's clock at host time AT_NS."""
        return self.estimate().ticks_at(at_ns)

    def ns_at(self, ticks: Ticks) -> HostTime:
        """Return the host time at which the node's clock shows TICKS."""
        return self.estimate().ns_at(ticks)

    def next_sample_ns(self, now_ns: int) -> int:
        """Return when to ask the node again, given that it was asked at NOW_NS."""
        if self.accepted < BURST_SAMPLES:
            return now_ns + BURST_INTERVAL_NS
        return now_ns + (SETTLE_INTERVAL_NS if self.accepted < SETTLE_SAMPLES else SAMPLE_INTERVAL_NS)

    # ------------------------------------------------------------------------------------------------- fit

    def _take(self, sent_ns: int, received_ns: int, ticks: Ticks) -> bool:
        last_ns = self._samples[-1].middle_ns if self._samples else -1
        middle_ns = (sent_ns + received_ns) // 2
        if sent_ns <= 0 or received_ns < sent_ns or middle_ns <= last_ns:
            self.unusable += 1
            return False
        self._samples.append(_Sample(middle_ns, (received_ns - sent_ns) * 1e-9, ticks))
        self.accepted += 1
        self._fit()
        return True

    def _fit(self) -> None:
        """Fit offset, rate and curvature, in seconds against the nominal clock, around the last sample."""
        last = self._samples[-1]
        fastest_s = self.round_trip_s
        normal = _Normal()
        normal.hold(1, 1 / RATE_PRIOR**2)
        normal.hold(2, 1 / CURVATURE_PRIOR_PER_S**2)
        for sample in self._samples:
            age_s = (sample.middle_ns - last.middle_ns) * 1e-9
            ahead_s = (sample.ticks - last.ticks) / self._freq_hz - age_s
            excess_s = sample.round_trip_s - fastest_s
            weight = math.exp(age_s / FADE_S) / (excess_s**2 / 12 + READING_FLOOR_S**2)
            normal.add(weight, age_s, ahead_s)
        offset_s, rate, offset_variance = normal.solve()
        error_s = fastest_s / 2 + CONFIDENCE * math.sqrt(offset_variance)
        self._estimate = ClockEstimate(
            self._freq_hz * (1 + rate),
            HostTime(last.middle_ns),
            Ticks(last.ticks + round(offset_s * self._freq_hz)),
            error_s,
        )


class _Normal:
    """Normal equations of a weighted fit of y = a + b·t + c·t²/2."""

    def __init__(self) -> None:
        self._m = [[0.0] * 3 for _ in range(3)]
        self._v = [0.0] * 3

    def hold(self, index: int, weight: float) -> None:
        """Hold one coefficient near zero."""
        self._m[index][index] += weight

    def add(self, weight: float, t: float, y: float) -> None:
        row = (1.0, t, t * t / 2)
        for i, left in enumerate(row):
            self._v[i] += weight * left * y
            for j, right in enumerate(row):
                self._m[i][j] += weight * left * right

    def solve(self) -> tuple[float, float, float]:
        """Return a, b and the variance of a."""
        (m00, m01, m02), (_, m11, m12), (_, _, m22) = self._m
        v0, v1, v2 = self._v
        # The matrix is symmetric and, thanks to the holds and one sample at t = 0, positive definite.
        c00, c01, c02 = m11 * m22 - m12 * m12, m02 * m12 - m01 * m22, m01 * m12 - m02 * m11
        c11, c12 = m00 * m22 - m02 * m02, m01 * m02 - m00 * m12
        determinant = m00 * c00 + m01 * c01 + m02 * c02
        a = (c00 * v0 + c01 * v1 + c02 * v2) / determinant
        b = (c01 * v0 + c11 * v1 + c12 * v2) / determinant
        return a, b, c00 / determinant
