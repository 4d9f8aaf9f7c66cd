"""The clock's filters once more, as plainly as can be: matrices and integrals, and figures of their own.

Slow, and written from the descriptions in nodes/clock/fit.py, clock_blend.py and clock_start.py: what those
compute in closed form, one number at a time, must be the same.
"""

import math
from dataclasses import dataclass, field

import numpy as np

from tests.nodes.bounds import Array, Product, cut

DELAY, SKEW = 3, 4
LEAD_WITH_SKEW = np.array([1.0, 0, 0, 0, 1])


def direction(sign: int) -> Array:
    """Return what an exchange bounds: the lead of the clock (and skew) in direction SIGN, and the delay."""
    return np.asarray(sign * LEAD_WITH_SKEW + np.eye(5)[DELAY])


@dataclass
class FilterByMatrices:
    """A filter of lead, rate, curvature, fastest delay and skew."""

    state: Array
    covariance: Array
    at_s: float
    spread_s: float
    warming: bool = True
    faded_s: float = 0.0
    nearest: dict[int, list[float]] = field(default_factory=lambda: {1: [], -1: []})

    def steady(self) -> "FilterByMatrices":
        """Return the same without any curvature, now and later."""
        keep = np.diag([1.0, 1, 0, 1, 1])
        return FilterByMatrices(
            keep @ self.state,
            keep @ self.covariance @ keep,
            self.at_s,
            self.spread_s,
            warming=False,
            faded_s=self.faded_s,
            nearest={sign: [*gaps] for sign, gaps in self.nearest.items()},
        )

    def add(self, at_s: float, lead_s: float, round_trip_s: float) -> float:
        """Take an exchange; return the logarithm of how probable it was."""
        self._move(at_s - self.at_s)
        self.at_s = at_s
        log_density = 0.0
        for sign in (1, -1):
            bound_s = sign * lead_s + round_trip_s / 2
            self._look_for_a_slower_way(sign, bound_s)
            log_density += self._cut(sign, bound_s)
            gap_s = min(max(self.gap(sign, bound_s), 0.0), 5 * self.spread_s)
            self.spread_s = max(255 / 256 * self.spread_s + 1.03 / 256 * gap_s, 1e-7)
        return log_density

    def gap(self, sign: int, bound_s: float) -> float:
        """Return how far the bound lies off."""
        return float(bound_s - direction(sign) @ self.state)

    def _move(self, dt: float) -> None:
        keep, relax = math.exp(-dt / 250), math.exp(-dt / 1000)
        move = np.diag([1, 1, keep, 1, relax])
        move[0, 1] = move[1, 2] = dt
        move[0, 2] = dt**2 / 2
        self.faded_s += (1 - relax) * float(self.state[SKEW])
        self.state = move @ self.state
        wander = [0.0, 0.0, 1e-16 * (1 - keep**2), (0.01 * self.spread_s) ** 2 * dt, 0.0]
        if not self.warming:
            wander[1:3] = 1.6e-19 * dt, 0.0
        self.covariance = move @ self.covariance @ move.T + np.diag(wander)

    def _look_for_a_slower_way(self, sign: int, bound_s: float) -> None:
        gaps = self.nearest[sign]
        gaps.append(self.gap(sign, bound_s))
        if min(gaps) < self.spread_s:
            gaps.clear()
        elif len(gaps) == 16:
            later = np.eye(5)[DELAY] + sign * np.eye(5)[SKEW]
            self.state = self.state + min(gaps) / 2 * later
            self.covariance = self.covariance + (min(gaps) / 2) ** 2 * np.outer(later, later)
            gaps.clear()

    def _cut(self, sign: int, bound_s: float) -> float:
        along = direction(sign)
        gap_s, noise_s = self.gap(sign, bound_s), 0.005 * self.spread_s
        if gap_s < -4 * math.sqrt(along @ self.covariance @ along + noise_s**2):
            earlier = np.eye(5)[DELAY] + sign * np.eye(5)[SKEW]
            self.covariance = self.covariance + (gap_s / 2) ** 2 * np.outer(earlier, earlier)
        loose = gap_s >= 7 * self.spread_s
        mean, variance = float(along @ self.state), float(along @ self.covariance @ along)
        found = cut(mean, variance, bound_s, self.spread_s, noise_s, loose=loose)
        column = self.covariance @ along
        self.state = self.state + column * (found.mean - mean) / variance
        self.covariance = (
            self.covariance - np.outer(column, column) * (1 - found.variance / variance) / variance
        )
        return math.log(math.exp(min(found.log_density, 3.0)) + 1e-4)


class BlendByMatrices:
    """Two filters, each weighed by what it foretold."""

    def __init__(self, first: FilterByMatrices) -> None:
        self.warming, self.steady = first, first.steady()
        self.odds = 0.0
        self.begun_again = 0

    def add(self, at_s: float, lead_s: float, round_trip_s: float) -> tuple[Array, Array]:
        """Take an exchange; return lead and rate with their covariance."""
        exchange = at_s, lead_s, round_trip_s
        warming = self.warming.add(*exchange)
        self.odds = min(self.odds + self.steady.add(*exchange) - warming, 1.0)
        if self.odds < -3:
            self.steady, self.odds = self.warming.steady(), -2.0
            self.begun_again += 1
        share = math.exp(self.odds) / (1 + math.exp(self.odds))
        parts = [(1 - share, self.warming), (share, self.steady)]
        mean = sum((weight * part.state[:2] for weight, part in parts), np.zeros(2))
        within = sum((weight * part.covariance[:2, :2] for weight, part in parts), np.zeros((2, 2)))
        between = sum(
            (weight * np.outer(part.state[:2] - mean, part.state[:2] - mean) for weight, part in parts),
            np.zeros((2, 2)),
        )
        return mean, within + between


class StartByRows:
    """Expectation propagation, one bound after the other."""

    def __init__(self) -> None:
        self.exchanges: list[tuple[float, float, float]] = []
        self.factors: list[tuple[float, float]] = []
        """Precision and precision times mean of what stands for a bound, two for every exchange."""
        self.spread_s = 0.0

    def add(self, at_s: float, lead_s: float, round_trip_s: float) -> tuple[Array, Array]:
        """Take an exchange; return state and covariance as they are at AT_S."""
        self.exchanges.append((at_s, lead_s, round_trip_s))
        self.factors += [(0.0, 0.0)] * 2
        bounds = [
            (np.array([sign, sign * t, sign * t**2 / 2, 1]), sign * lead + trip / 2)
            for t, lead, trip in self.exchanges
            for sign in (1, -1)
        ]
        mean, covariance = self._belief(bounds)
        for _ in range(2):
            self._judge_spread(bounds, mean)
            self.factors = [
                self._factor(along, bound, factor, mean, covariance)
                for (along, bound), factor in zip(bounds, self.factors, strict=True)
            ]
            mean, covariance = self._belief(bounds)
        move = np.eye(4)
        move[0, 1] = move[1, 2] = at_s
        move[0, 2] = at_s**2 / 2
        return move @ mean, move @ covariance @ move.T

    def _belief(self, bounds: list[tuple[Array, float]]) -> tuple[Array, Array]:
        _, lead_s, fastest_s = min(self.exchanges, key=lambda exchange: exchange[2])
        sd = np.array([fastest_s, 1.5e-4, 1e-8, fastest_s / 3])
        information = np.diag(sd**-2)
        pull = np.array([lead_s, 0, 0, fastest_s / 3]) * sd**-2
        for (along, _), (precision, shift) in zip(bounds, self.factors, strict=True):
            information += precision * np.outer(along, along)
            pull += shift * along
        return np.linalg.solve(information, pull), np.linalg.inv(information)

    def _judge_spread(self, bounds: list[tuple[Array, float]], mean: Array) -> None:
        trips = [trip for *_, trip in self.exchanges]
        fastest_s, count = min(trips), len(trips)
        guess = fastest_s / 6
        if count > 2:
            guess = max((float(np.median(trips)) - fastest_s) / 1.7, fastest_s / 50)
        if count < 6:
            self.spread_s = max(guess, 1e-7)
        else:
            gaps = [min(max(bound - float(along @ mean), 0), 5 * self.spread_s) for along, bound in bounds]
            self.spread_s = max((sum(gaps) + 2 * guess) / (2 * count + 0.5), 1e-7)

    def _factor(
        self, along: Array, bound: float, factor: tuple[float, float], mean: Array, covariance: Array
    ) -> tuple[float, float]:
        precision, shift = factor
        variance, middle = float(along @ covariance @ along), float(along @ mean)
        others = max(1 / variance - precision, 1e-3 / variance)
        centre = (middle / variance - shift) / others
        loose = bound - middle >= 7 * self.spread_s
        found: Product = cut(centre, 1 / others, bound, self.spread_s, 0.005 * self.spread_s, loose=loose)
        wanted = 1 / found.variance - others, found.mean / found.variance - centre * others
        return precision + 0.6 * (wanted[0] - precision), shift + 0.6 * (wanted[1] - shift)
