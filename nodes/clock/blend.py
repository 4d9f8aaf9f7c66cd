"""A clock that is mostly steady and sometimes warms up: two filters, weighted by their predictions.

The first lets the rate drift in one direction, so it follows temperature but remembers only some minutes. The
second assumes a constant rate and so remembers much longer; when the temperature changes, its predictions get
worse, it loses its weight, and it starts again from the state of the first.
"""

import math
from typing import Final

from nodes.clock.fit import Filter

FIRST_ODDS: Final = -2.0
"""Logarithm of the odds of a steady filter that starts again."""
MOST_ODDS: Final = 1.0
"""Upper limit of the odds, so that a change is detected soon."""
LEAST_ODDS: Final = -3.0
"""Odds below which the steady filter starts again."""


class Blend:
    """Continues from FIRST, like ``Filter``; state and covariance are lead (s) and rate only."""

    def __init__(self, first: Filter) -> None:
        self._warming = first
        self._steady = first.steady()
        self._odds = 0.0
        self.state = first.state[:2]
        self.covariance = [row[:2] for row in first.covariance[:2]]

    def add(self, at_s: float, lead_s: float, round_trip_s: float) -> None:
        """Process an exchange in whose middle, AT_S, the clock would have been ahead by LEAD_S."""
        warming = self._warming.add(at_s, lead_s, round_trip_s)
        steady = self._steady.add(at_s, lead_s, round_trip_s)
        self._odds = min(self._odds + steady - warming, MOST_ODDS)
        if self._odds < LEAST_ODDS:
            self._steady, self._odds = self._warming.steady(), FIRST_ODDS
        self._mix(1 / (1 + math.exp(-self._odds)))

    @property
    def faded_s(self) -> float:
        """Largest change of the lead from discarding a difference of the delays."""
        return max(abs(self._warming.faded_s), abs(self._steady.faded_s))

    def _mix(self, share: float) -> None:
        """Set state and covariance to those of the mixture in which the steady filter has weight SHARE."""
        one, two = self._warming, self._steady
        apart = [two.state[i] - one.state[i] for i in (0, 1)]
        for i in (0, 1):
            self.state[i] = one.state[i] + share * apart[i]
            for j in (0, 1):
                within = (1 - share) * one.covariance[i][j] + share * two.covariance[i][j]
                self.covariance[i][j] = within + share * (1 - share) * apart[i] * apart[j]
