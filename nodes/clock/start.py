"""The first samples of a clock, fitted together: lead, rate, curvature and fastest delay.

Expectation propagation: every bound (see fit.py) is replaced by the Gaussian factor that gives the belief
the same mean and variance as the bound itself would. All factors are refined with each new sample, so the
first samples are evaluated again with what is known now, and a bad start does no harm.
"""

import math
from bisect import insort
from operator import mul
from typing import Final

from nodes.clock.fit import CURVATURE_SD, LEAST_SPREAD_S, LOOSE, NOISE, RATE_SD, hazard
from nodes.support.linear import inverse

SWEEPS: Final = 2
"""Refinements with each new sample. With one, the error bound is too small twice as often; more make no
significant difference in bench/clock.py."""
DAMPING: Final = 0.6
SIZE: Final = 4
"""Lead, rate, curvature, fastest delay."""


class _Bound:
    """The lead at one time, times SIGN, and the fastest delay are together at most LIMIT_S.

    With the Gaussian factor that replaces it.
    """

    __slots__ = ("bend", "limit_s", "precision", "shift", "sign", "time_s")

    def __init__(self, sign: float, time_s: float, limit_s: float) -> None:
        self.sign = sign
        self.time_s = time_s
        self.bend = time_s * time_s / 2
        self.limit_s = limit_s
        self.precision = 0.0
        self.shift = 0.0


class Start:
    """Fit of all samples collected so far."""

    def __init__(self) -> None:
        self._trips_s: list[float] = []
        """Sorted."""
        self._bounds: list[_Bound] = []
        """Two of each exchange."""
        self.spread_s = 0.0
        """Mean excess over the shortest delay, one way."""

    @property
    def samples(self) -> int:
        """Number of samples so far."""
        return len(self._trips_s)

    def add(self, at_s: float, lead_s: float, round_trip_s: float) -> tuple[list[float], list[list[float]]]:
        """Process an exchange; return state and covariance at AT_S, which must not decrease."""
        is_fastest = not self._trips_s or round_trip_s < self._trips_s[0]
        insort(self._trips_s, round_trip_s)
        for sign in (1.0, -1.0):
            self._bounds.append(_Bound(sign, at_s, round_trip_s / 2 + sign * lead_s))
        if is_fastest:
            self._expect(lead_s, round_trip_s)
        guess = self._guess()
        for _ in range(SWEEPS):
            self._sweep(guess)
            self._solve()
        return self._at(at_s)

    def _at(self, at_s: float) -> tuple[list[float], list[list[float]]]:
        """Return state and covariance, moved to AT_S."""
        bend = at_s * at_s / 2
        state, covariance = [*self._mean], [[*row] for row in self._covariance]
        for row in (state, *covariance):
            row[0] += row[1] * at_s + row[2] * bend
            row[1] += row[2] * at_s
        lead, rate, curvature, _ = covariance
        for i in range(SIZE):
            lead[i] += rate[i] * at_s + curvature[i] * bend
            rate[i] += curvature[i] * at_s
        return state, covariance

    def _expect(self, lead_s: float, fastest_s: float) -> None:
        """Set the prior belief, without any bound, given the fastest exchange."""
        self._prior = [deviation**-2.0 for deviation in (fastest_s, RATE_SD, CURVATURE_SD, fastest_s / 3)]
        expected = (lead_s, 0.0, 0.0, fastest_s / 3)
        self._pull = [precision * value for precision, value in zip(self._prior, expected, strict=True)]
        self._solve()

    def _guess(self) -> float:
        """Return the mean excess delay, estimated from the spread of the round trips."""
        trips_s, count = self._trips_s, len(self._trips_s)
        guess = trips_s[0] / 6
        if count >= 3:
            median_s = (trips_s[count // 2] + trips_s[~(count // 2)]) / 2
            guess = max((median_s - trips_s[0]) / 1.7, trips_s[0] / 50)
        if count < 6:
            self.spread_s = max(guess, LEAST_SPREAD_S)
        return guess

    def _solve(self) -> None:
        """Make the belief of the prior and all factors."""
        p0, p1, p2, p3 = self._pull
        # The sums of sign^i * time^j, weighted by the factors' precision.
        all_0 = all_t = all_b = all_tt = all_tb = all_bb = signed_0 = signed_t = signed_b = 0.0
        for bound in self._bounds:
            weight, t, b = bound.precision, bound.time_s, bound.bend
            all_0, all_t, all_b = all_0 + weight, all_t + weight * t, all_b + weight * b
            all_tt, all_tb, all_bb = all_tt + weight * t * t, all_tb + weight * t * b, all_bb + weight * b * b
            weight *= bound.sign
            signed_0, signed_t, signed_b = signed_0 + weight, signed_t + weight * t, signed_b + weight * b
            shift = bound.sign * bound.shift
            p0, p1, p2, p3 = p0 + shift, p1 + shift * t, p2 + shift * b, p3 + bound.shift
        prior = self._prior
        self._covariance = inverse(
            (
                (all_0 + prior[0], all_t, all_b, signed_0),
                (all_t, all_tt + prior[1], all_tb, signed_t),
                (all_b, all_tb, all_bb + prior[2], signed_b),
                (signed_0, signed_t, signed_b, all_0 + prior[3]),
            )
        )
        self._mean = [sum(map(mul, row, (p0, p1, p2, p3))) for row in self._covariance]

    def _believe(self) -> list[tuple[float, float]]:
        """Return mean and variance of what is bounded, for each bound, by the belief."""
        (c00, c01, c02, c03), (_, c11, c12, c13), (_, _, c22, c23), (_, _, _, c33) = self._covariance
        m0, m1, m2, m3 = self._mean
        found = []
        for bound in self._bounds:
            sign, t, b = bound.sign, bound.time_s, bound.bend
            lead = c00 + t * (2 * (c01 + c12 * b) + c11 * t) + b * (2 * c02 + c22 * b)
            found.append(
                (
                    sign * (m0 + m1 * t + m2 * b) + m3,
                    lead + 2 * sign * (c03 + c13 * t + c23 * b) + c33,
                )
            )
        return found

    def _sweep(self, guess: float) -> None:
        """Refine the factors of all bounds."""
        beliefs = self._believe()
        if len(beliefs) >= 12:
            gaps = (bound.limit_s - mean for bound, (mean, _) in zip(self._bounds, beliefs, strict=True))
            near = sum(min(max(gap, 0.0), 5 * self.spread_s) for gap in gaps)
            self.spread_s = max((near + 2 * guess) / (len(beliefs) + 0.5), LEAST_SPREAD_S)
        for bound, (mean, variance) in zip(self._bounds, beliefs, strict=True):
            self._refine(bound, mean, variance)

    def _refine(self, bound: _Bound, mean: float, variance: float) -> None:
        """Apply BOUND to the belief from all the others; MEAN and VARIANCE are what all together believe."""
        spread_s = self.spread_s
        other = 1 / max(1 / variance - bound.precision, 1e-3 / variance)
        centre = other * (mean / variance - bound.shift)
        tilt = 1 / spread_s if bound.limit_s - mean < LOOSE * spread_s else 0.0
        s = math.sqrt(other + (NOISE * spread_s) ** 2)
        k = (bound.limit_s - centre) / s - tilt * s
        r = hazard(k)
        cut = min(r * (k + r), 1 - 1e-9) / (s * s)
        left = 1 - other * cut
        bound.precision += DAMPING * (cut / left - bound.precision)
        bound.shift += DAMPING * ((centre * cut + tilt - r / s) / left - bound.shift)
