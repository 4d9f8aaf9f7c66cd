"""The first samples of a clock, fitted together: lead, rate, curvature and fastest delay.

Expectation propagation: every bound (see fit.py) is replaced by the Gaussian factor that gives the belief
the same mean and variance as the bound itself would. All factors are refined with each new sample, so the
first samples are evaluated again with what is known now, and a bad start does no harm. The arithmetic that
goes over all bounds is in start_fit.c.
"""

from bisect import insort
from typing import Any, Final

from nodes.clock._clock import ffi, lib
from nodes.clock.fit import CURVATURE_SD, LEAST_SPREAD_S, LOOSE, NOISE, RATE_SD

START_SAMPLES: Final[int] = lib.START_SAMPLES
"""Number of samples fitted together at most."""
SWEEPS: Final = 2
"""Refinements with each new sample. With one, the error bound is too small twice as often; more make no
significant difference in bench/clock.py."""
DAMPING: Final = 0.6
"""Share of the way to its new value that a factor moves in a refinement."""


class Start:
    """Fit of all samples collected so far."""

    def __init__(self) -> None:
        self._trips_s: list[float] = []
        """Sorted."""
        self._fit: Any = ffi.new("struct start_fit *")
        self.spread_s = 0.0
        """Mean excess over the shortest delay, one way."""

    @property
    def samples(self) -> int:
        """Number of samples so far."""
        return len(self._trips_s)

    def add(self, at_s: float, lead_s: float, round_trip_s: float) -> tuple[list[float], list[list[float]]]:
        """Process an exchange; return state and covariance at AT_S, which must not decrease.

        IndexError after START_SAMPLES.
        """
        fit, way_s = self._fit, round_trip_s / 2
        exchange = fit.exchanges[fit.count]
        exchange.at_s = at_s
        exchange.bound_s = way_s + lead_s, way_s - lead_s
        fit.count += 1
        is_fastest = not self._trips_s or round_trip_s < self._trips_s[0]
        insort(self._trips_s, round_trip_s)
        if is_fastest:
            self._expect(lead_s, round_trip_s)
        guess = self._guess()
        for _ in range(SWEEPS):
            if self.samples >= 6:
                near_s = lib.start_fit_gaps(fit, 5 * self.spread_s)
                self.spread_s = max((near_s + 2 * guess) / (2 * self.samples + 0.5), LEAST_SPREAD_S)
            spread_s = self.spread_s
            lib.start_fit_sweep(fit, spread_s, NOISE * spread_s, LOOSE * spread_s, DAMPING)
            lib.start_fit_solve(fit)
        return self._moved(at_s)

    def _moved(self, at_s: float) -> tuple[list[float], list[list[float]]]:
        """Return state and covariance, which the fit has for time 0, for AT_S."""
        state, covariance = list(self._fit.mean), [list(row) for row in self._fit.covariance]
        bend = at_s * at_s / 2
        for row in (state, *covariance):
            row[0] += row[1] * at_s + row[2] * bend
            row[1] += row[2] * at_s
        lead, rate, curvature, _ = covariance
        for i in range(len(state)):
            lead[i] += rate[i] * at_s + curvature[i] * bend
            rate[i] += curvature[i] * at_s
        return state, covariance

    def _expect(self, lead_s: float, fastest_s: float) -> None:
        """Set the prior belief, without any bound, given the fastest exchange."""
        prior = [sd**-2.0 for sd in (fastest_s, RATE_SD, CURVATURE_SD, fastest_s / 3)]
        self._fit.prior = prior
        self._fit.pull = prior[0] * lead_s, 0.0, 0.0, prior[3] * fastest_s / 3
        lib.start_fit_solve(self._fit)

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
