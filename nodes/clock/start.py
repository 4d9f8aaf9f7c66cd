"""The first samples of a clock, fitted together: lead, rate, curvature and fastest delay.

Expectation propagation: every bound (see clock_fit.py) is replaced by the Gaussian factor that leaves the
belief the same mean and variance as the bound itself would. All are refined with each new sample, so what the
first ones meant is judged again by what is known now, and a bad beginning does no harm.
"""

from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from nodes.clock.fit import CURVATURE_SD, LEAST_SPREAD_S, LOOSE, NOISE, RATE_SD, hazard

SWEEPS: Final = 2
"""With each new sample; more change no figure of bench/clock.py that could be told from chance."""
DAMPING: Final = 0.6
Array = NDArray[np.float64]


class Start:
    """Collects samples and fits all of them."""

    def __init__(self) -> None:
        self._rows: list[tuple[float, float, float]] = []
        self._precision: Array = np.zeros(0)
        self._shift: Array = np.zeros(0)
        self.spread_s = 0.0
        """Mean delay on top of the fastest, one way."""

    @property
    def samples(self) -> int:
        """How many have been taken."""
        return len(self._rows)

    def add(self, at_s: float, lead_s: float, round_trip_s: float) -> tuple[list[float], list[list[float]]]:
        """Take an exchange; return state and covariance at AT_S, which must not go back."""
        self._rows.append((at_s, lead_s, round_trip_s))
        self._precision = np.append(self._precision, (0.0, 0.0))
        self._shift = np.append(self._shift, (0.0, 0.0))
        mean, covariance = self._fit()
        move = np.eye(4)
        move[0, 1] = move[1, 2] = at_s
        move[0, 2] = at_s * at_s / 2
        state: list[float] = (move @ mean).tolist()
        moved: list[list[float]] = (move @ covariance @ move.T).tolist()
        return state, moved

    def _fit(self) -> tuple[Array, Array]:
        t, lead, trip = np.array(self._rows).T
        sign = np.tile([1.0, -1.0], len(t))
        t2 = np.repeat(t, 2)
        rows = np.stack([sign, sign * t2, sign * t2 * t2 / 2, np.ones(len(t2))], 1)
        bounds = sign * np.repeat(lead, 2) + np.repeat(trip, 2) / 2
        best = int(trip.argmin())
        fastest = float(trip[best])
        prior = np.array([fastest, RATE_SD, CURVATURE_SD, fastest / 3]) ** -2.0
        pull = prior * np.array([lead[best], 0.0, 0.0, fastest / 3])
        guess = self._guess(trip, fastest)
        for _ in range(SWEEPS):
            mean, covariance = self._solve(rows, prior, pull)
            self._sweep(rows, bounds, mean, covariance, guess)
        return self._solve(rows, prior, pull)

    def _guess(self, trip: Array, fastest: float) -> float:
        """Return the mean delay on top as the spread of the round trips shows it."""
        few = len(trip) < 3
        guess = fastest / 6 if few else max((float(np.median(trip)) - fastest) / 1.7, fastest / 50)
        if len(trip) < 6:
            self.spread_s = max(guess, LEAST_SPREAD_S)
        return guess

    def _solve(self, rows: Array, prior: Array, pull: Array) -> tuple[Array, Array]:
        information = np.diag(prior) + (rows * self._precision[:, None]).T @ rows
        covariance: Array = np.asarray(np.linalg.inv(information), dtype=np.float64)
        return covariance @ (pull + rows.T @ self._shift), covariance

    def _sweep(self, rows: Array, bounds: Array, mean: Array, covariance: Array, guess: float) -> None:
        variance = ((rows @ covariance) * rows).sum(axis=1)
        middle = rows @ mean
        gap = bounds - middle
        if len(gap) >= 12:
            near = np.clip(gap, 0.0, 5 * self.spread_s).sum()
            self.spread_s = max((near + 2 * guess) / (len(gap) + 0.5), LEAST_SPREAD_S)
        # Each bound sees what all the others say.
        other = 1 / np.maximum(1 / variance - self._precision, 1e-3 / variance)
        centre = other * (middle / variance - self._shift)
        tilt = np.where(gap < LOOSE * self.spread_s, 1 / self.spread_s, 0.0)
        s = np.sqrt(other + (NOISE * self.spread_s) ** 2)
        k = (bounds - centre) / s - tilt * s
        r: Any = np.array([hazard(x) for x in k.tolist()])
        cut = np.clip(r * (k + r), 1e-9, 1 - 1e-9) / (s * s)
        push = tilt - r / s
        left = 1 - other * cut
        self._precision += DAMPING * (cut / left - self._precision)
        self._shift += DAMPING * ((centre * cut + push) / left - self._shift)
