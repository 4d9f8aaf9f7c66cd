"""The filter of a settled clock: a node's lead over host time, truncated by one-sided bounds.

State: lead of the node's clock over host time (s), its rate, the rate's change (1/s), the shortest one-way
delay (s) and half the difference of the two delays (s). An exchange bounds lead + delay out from above, and
delay back - lead likewise; the distance to the bound is exponential. Each bound updates the Gaussian belief
with the exact mean and variance of the product, so tight bounds truncate it and loose ones hardly count.
"""

import copy
import math
from collections.abc import Sequence
from typing import Final

from nodes.clock._clock import lib

SIZE: Final = 5
RATE_SD: Final = 1.5e-4
"""Standard deviation of a clock's rate against its nominal one, before anything is measured."""
CURVATURE_SD: Final = 1e-8
"""Standard deviation of a rate's change per second: a crystal in a warming board."""
RATE_WALK: Final = 4e-10
"""Random walk of a steady rate, per square root of a second."""
CURVATURE_FADE_S: Final = 250.0
SKEW_FADE_S: Final = 1000.0
DELAY_WANDER: Final = 0.01
"""Random walk of the shortest delay, per square root of a second, relative to the mean excess delay."""
NOISE: Final = 0.005
"""Reading noise relative to the mean excess over the shortest delay."""
LOOSE: Final = 7.0
"""An exchange further from its bound than so many mean delays does not count for their mean."""
MEMORY: Final = 256.0
"""Number of delays over which their mean is taken."""
LATE: Final = 16
"""So many implausibly late exchanges in one direction mean that its delay has grown."""
LEAST_SPREAD_S: Final = 1e-7
OUTLIERS: Final = 1e-4
"""Density of an exchange that no bound explains, relative to the mean delay: limits its evidence."""


def hazard(k: float) -> float:
    """Return φ(k)/Φ(k) of the normal distribution, for any K without underflow."""
    return float(lib.normal_hazard(k))


def log_share(k: float) -> float:
    """Return log Φ(k) of the normal distribution, for any K without underflow."""
    if k < -25.0:
        return -k * k / 2 - math.log(-k) - 0.9189385332046727
    return math.log(0.5 * math.erfc(-k * 0.7071067811865476))


class Filter:
    """Filter that continues from STATE and COVARIANCE (lead, rate, curvature, delay) at AT_S."""

    warming = True
    """Whether the rate may drift in one direction for long; else it only wanders slightly."""

    def __init__(
        self, state: Sequence[float], covariance: Sequence[Sequence[float]], at_s: float, spread_s: float
    ) -> None:
        self.state = [*state, 0.0]
        self.covariance = [[*row, 0.0] for row in covariance] + [[0.0] * SIZE]
        self._at_s = at_s
        self._spread_s = spread_s
        self.faded_s = 0.0
        """Skew discarded so far for lack of evidence: the lead may be wrong by so much."""
        self._nearest: dict[int, tuple[int, float]] = {1: (0, math.inf), -1: (0, math.inf)}

    def steady(self) -> "Filter":
        """Return a filter with the same state that assumes a constant rate from now on."""
        other = copy.copy(self)
        other.state = [*self.state]
        other.covariance = [[*row] for row in self.covariance]
        other._nearest = {**self._nearest}  # noqa: SLF001 - a copy of its own kind
        other.warming = False
        other.state[2] = 0.0
        for i in range(SIZE):
            other.covariance[2][i] = other.covariance[i][2] = 0.0
        return other

    def add(self, at_s: float, lead_s: float, round_trip_s: float) -> float:
        """Process an exchange in whose middle, AT_S, the clock would have been ahead by LEAD_S.

        Return how well it was predicted: the logarithm of its density relative to the mean delay.
        """
        foretold = 0.0
        self._predict(at_s - self._at_s)
        self._at_s = at_s
        for sign in (1, -1):
            bound_s = sign * lead_s + round_trip_s / 2
            self._watch(sign, bound_s)
            foretold += self._bound(sign, bound_s)
            gap_s = min(max(self._gap(sign, bound_s), 0.0), 5 * self._spread_s)
            # 1.03: compensates what the limit of 5 takes off the mean
            self._spread_s += (1.03 * gap_s - self._spread_s) / MEMORY
            self._spread_s = max(self._spread_s, LEAST_SPREAD_S)
        return foretold

    def _gap(self, sign: int, bound_s: float) -> float:
        x = self.state
        return bound_s - sign * (x[0] + x[4]) - x[3]

    def _predict(self, dt: float) -> None:
        x, p = self.state, self.covariance
        keep, relax, half = math.exp(-dt / CURVATURE_FADE_S), math.exp(-dt / SKEW_FADE_S), dt * dt / 2
        self.faded_s += x[4] * (1 - relax)
        for row in (x, *p):
            row[0] += row[1] * dt + row[2] * half
            row[1] += row[2] * dt
            row[2] *= keep
            row[4] *= relax
        p0, p1, p2, p4 = p[0], p[1], p[2], p[4]
        for i in range(SIZE):
            p0[i] += p1[i] * dt + p2[i] * half
            p1[i] += p2[i] * dt
            p2[i] *= keep
            p4[i] *= relax
        if self.warming:
            p2[2] += CURVATURE_SD**2 * (1 - keep * keep)
        else:
            p1[1] += RATE_WALK**2 * dt
        p[3][3] += (DELAY_WANDER * self._spread_s) ** 2 * dt

    def _doubt(self, sign: int, by_s: float) -> None:
        """Allow the shortest delay in one direction to change by about BY_S."""
        p, variance = self.covariance, by_s * by_s / 4
        p[3][3] += variance
        p[4][4] += variance
        p[3][4] += sign * variance
        p[4][3] += sign * variance

    def _watch(self, sign: int, bound_s: float) -> None:
        """Detect that one direction has become slower: none of LATE exchanges comes near its bound."""
        count, nearest_s = self._nearest[sign]
        count, nearest_s = count + 1, min(nearest_s, self._gap(sign, bound_s))
        if nearest_s < self._spread_s:
            count, nearest_s = 0, math.inf
        elif count >= LATE:
            self.state[3] += nearest_s / 2
            self.state[4] += sign * nearest_s / 2
            self._doubt(sign, nearest_s)
            count, nearest_s = 0, math.inf
        self._nearest[sign] = count, nearest_s

    def _bound(self, sign: int, bound_s: float) -> float:
        """Apply sign·(lead + skew) + delay <= BOUND_S, with an exponential distance; return as ``add``."""
        x, p = self.state, self.covariance
        column = [sign * (row[0] + row[4]) + row[3] for row in p]
        variance = sign * (column[0] + column[4]) + column[3]
        gap_s = self._gap(sign, bound_s)
        noise = (NOISE * self._spread_s) ** 2
        if gap_s < 0 and gap_s * gap_s > 16 * (variance + noise):
            self._doubt(sign, gap_s)
            column = [sign * (row[0] + row[4]) + row[3] for row in p]
            variance = sign * (column[0] + column[4]) + column[3]
        s = math.sqrt(max(variance, 0.0) + noise)
        pull = 1 / self._spread_s if gap_s < LOOSE * self._spread_s else 0.0
        k = gap_s / s - pull * s
        foretold = min(log_share(k) + (s * pull) ** 2 / 2 - gap_s * pull, 3.0) if pull else -math.inf
        r = hazard(k)
        push, cut = pull - r / s, min(max(r * (k + r), 0.0), 1.0) / (s * s)
        for i, own in enumerate(column):
            x[i] += own * push
            row = p[i]
            for j, other in enumerate(column):
                row[j] -= own * cut * other
        return math.log(math.exp(foretold) + OUTLIERS)
