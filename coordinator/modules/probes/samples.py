"""How several measurements of one place become one height: pure, and the same for every probe."""

import math
from dataclasses import dataclass
from typing import Final

AVERAGE: Final = "average"
MEDIAN: Final = "median"


@dataclass(frozen=True, slots=True)
class SampleRules:
    """How a place is measured."""

    samples: int = 1
    result: str = AVERAGE
    """Of what is measured: average or median."""
    tolerance_mm: float = 0.1
    """How far apart the samples may be."""
    retries: int = 0
    """How often all samples are taken again where they are further apart."""
    drop_first: bool = False
    """Whether the first measurement of a place does not count."""


class SampleSeries:
    """The measurements of one place, taken until they are enough."""

    def __init__(self, rules: SampleRules) -> None:
        self._rules = rules
        self._heights: list[float] = []
        self._dropped = not rules.drop_first
        self._retries = 0

    def take(self, height: float) -> str:
        """Add a measurement; return a remark for the user, or nothing."""
        if not self._dropped:
            self._dropped = True
            return "the first result is dropped"
        self._heights.append(height)
        if self.spread_mm > self._rules.tolerance_mm and self._retries < self._rules.retries:
            self._retries += 1
            spread_mm, self._heights = self.spread_mm, []
            return (
                f"the samples are {spread_mm:.4f} mm apart, more than samples_tolerance"
                f" ({self._rules.tolerance_mm:g} mm): retry {self._retries} of {self._rules.retries}"
            )
        return ""

    @property
    def spread_mm(self) -> float:
        """How far apart the measurements are that count."""
        return max(self._heights) - min(self._heights) if self._heights else 0.0

    @property
    def failed(self) -> str:
        """Why there will be no result; empty: there will be one."""
        if self.spread_mm <= self._rules.tolerance_mm:
            return ""
        return (
            f"the samples are {self.spread_mm:.4f} mm apart, more than samples_tolerance"
            f" ({self._rules.tolerance_mm:g} mm), after {self._retries} retries: check that nothing of the"
            " probe or the axes is loose"
        )

    @property
    def is_complete(self) -> bool:
        """Whether there are as many measurements as there have to be."""
        return len(self._heights) >= self._rules.samples

    @property
    def result(self) -> float:
        """The height by these measurements, mm."""
        return combined(self._heights, self._rules.result)


def combined(heights: list[float], result: str) -> float:
    """Return the average or the median of HEIGHTS, of which there is one at least."""
    if result != MEDIAN:
        return math.fsum(heights) / len(heights)
    ordered, half = sorted(heights), len(heights) // 2
    return (ordered[half] + ordered[~half]) / 2
