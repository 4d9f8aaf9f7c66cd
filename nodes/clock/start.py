"""The first samples of a clock, fitted together: lead, rate, curvature and fastest delay.

Expectation propagation: every bound (see fit.py) is replaced by the Gaussian factor that gives the belief
the same mean and variance as the bound itself would. All factors are refined with each new sample, so the
first samples are evaluated again with what is known now, and a bad start does no harm.
"""

from bisect import insort
from typing import Final

import numpy as np
from numpy.typing import NDArray

from nodes.clock.fit import CURVATURE_SD, LEAST_SPREAD_S, LOOSE, NOISE, RATE_SD, hazard

SWEEPS: Final = 2
"""Refinements with each new sample. With one, the error bound is too small twice as often; more make no
significant difference in bench/clock.py."""
DAMPING: Final = 0.6
Array = NDArray[np.float64]


class Start:
    """Fit of all samples collected so far."""

    def __init__(self) -> None:
        self._trips_s: list[float] = []
        """Sorted."""
        # For every exchange two bounds, and the factors that replace them:
        self._rows: Array = np.zeros((0, 4))
        self._bounds: Array = np.zeros(0)
        self._precision: Array = np.zeros(0)
        self._shift: Array = np.zeros(0)
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
        bend, way_s = at_s * at_s / 2, round_trip_s / 2
        both = (1.0, at_s, bend, 1.0), (-1.0, -at_s, -bend, 1.0)
        self._rows = np.concatenate((self._rows, both))
        self._bounds = np.concatenate((self._bounds, (way_s + lead_s, way_s - lead_s)))
        self._precision = np.concatenate((self._precision, np.zeros(2)))
        self._shift = np.concatenate((self._shift, np.zeros(2)))
        if is_fastest:
            self._expect(lead_s, round_trip_s)
        guess = self._guess()
        for _ in range(SWEEPS):
            self._sweep(guess)
            self._solve()
        move = np.array(
            ((1.0, at_s, bend, 0.0), (0.0, 1.0, at_s, 0.0), (0.0, 0.0, 1.0, 0.0), (0.0, 0.0, 0.0, 1.0))
        )
        state: list[float] = (move @ self._mean).tolist()
        moved: list[list[float]] = (move @ self._covariance @ move.T).tolist()
        return state, moved

    def _expect(self, lead_s: float, fastest_s: float) -> None:
        """Set the prior belief, without any bound, given the fastest exchange."""
        prior = np.array((fastest_s, RATE_SD, CURVATURE_SD, fastest_s / 3)) ** -2.0
        self._prior = np.diag(prior)
        self._pull = prior * (lead_s, 0.0, 0.0, fastest_s / 3)
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
        information = self._prior + (self._rows.T * self._precision) @ self._rows
        self._covariance: Array = np.asarray(np.linalg.inv(information), dtype=np.float64)
        self._mean: Array = self._covariance @ (self._pull + self._shift @ self._rows)

    def _sweep(self, guess: float) -> None:
        variance = ((self._rows @ self._covariance) * self._rows).sum(axis=1)
        middle = self._rows @ self._mean
        gap = self._bounds - middle
        if len(gap) >= 12:
            near = float(np.minimum(np.maximum(gap, 0.0), 5 * self.spread_s).sum())
            self.spread_s = max((near + 2 * guess) / (len(gap) + 0.5), LEAST_SPREAD_S)
        # Each bound is applied to the belief from all the others.
        other = 1 / np.maximum(1 / variance - self._precision, 1e-3 / variance)
        centre = other * (middle / variance - self._shift)
        tilt = (gap < LOOSE * self.spread_s) / self.spread_s
        s = np.sqrt(other + (NOISE * self.spread_s) ** 2)
        k = (self._bounds - centre) / s - tilt * s
        r = np.array([hazard(x) for x in k.tolist()])
        cut = np.minimum(r * (k + r), 1 - 1e-9) / (s * s)
        push = tilt - r / s
        left = 1 - other * cut
        self._precision += DAMPING * (cut / left - self._precision)
        self._shift += DAMPING * ((centre * cut + push) / left - self._shift)
