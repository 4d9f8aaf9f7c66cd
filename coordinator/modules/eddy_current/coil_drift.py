"""How the frequency of an eddy current probe's coil changes with its temperature (pure).

For each of some heights it is a polynomial of the second degree, by calibration. A frequency is adapted from
one temperature to another by where it is between those of the heights next to it.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

from coordinator.config.options import BadValue, Option, parse_decimal
from coordinator.support.lazy_numpy import Numbers, np

HEIGHTS: Final = (0.1, 0.5, 1.0, 1.5, 2.0, 2.5, 3.0, 3.5, 4.0)
"""Of a calibration, mm."""
LEAST: Final = 3
"""Temperatures that a calibration needs, and heights."""
DEGREE: Final = 2
COLDEST_C: Final = -50.0
STEP_C: Final = 1.0
"""Between two temperatures at which a calibration is checked."""

Sample = Sequence[tuple[float, float]]
"""At each of HEIGHTS the temperature, °C, and the frequency, Hz."""


@dataclass(frozen=True, slots=True)
class CoilDrift:
    """Polynomials (a, b, c of a + b·T + c·T², Hz, T in °C) by height, mm, rising."""

    curves: tuple[tuple[float, tuple[float, float, float]], ...]

    def frequencies(self, celsius: float) -> Numbers:
        """Return the frequencies at the heights, Hz."""
        return np.array([a + b * celsius + c * celsius * celsius for _, (a, b, c) in self.curves])

    def adapted(self, frequency_hz: float, from_c: float, to_c: float) -> float:
        """Return what a frequency at FROM_C would be at TO_C, with the coil at the same height."""
        before, after = self.frequencies(from_c)[::-1], self.frequencies(to_c)[::-1]
        nearest = min(max(frequency_hz, before[0]), before[-1])
        return float(np.interp(nearest, before, after) + frequency_hz - nearest)

    def is_plausible(self, low_c: float, high_c: float) -> bool:
        """Whether the frequency falls with the height at all temperatures from LOW_C to HIGH_C."""
        temperatures = np.arange(low_c, high_c + STEP_C, STEP_C)
        return all(bool(np.all(np.diff(self.frequencies(celsius)) < 0)) for celsius in temperatures)

    def text(self) -> str:
        """Return it as it is saved."""
        return "\n" + "\n".join(f"{height:g}: {a:.6f}, {b:.9f}, {c:.9f}" for height, (a, b, c) in self.curves)


def drift_of(samples: Sequence[Sample]) -> CoilDrift:
    """Return the drift by SAMPLES at LEAST or more temperatures, by least squares."""
    curves = []
    for height, points in zip(HEIGHTS, zip(*samples, strict=True), strict=True):
        temperatures, frequencies = zip(*points, strict=True)
        a, b, c = np.polynomial.polynomial.polyfit(temperatures, frequencies, DEGREE)
        curves.append((height, (float(a), float(b), float(c))))
    return CoilDrift(tuple(curves))


@dataclass(frozen=True, slots=True, kw_only=True)
class DriftOption(Option[CoilDrift]):
    """A drift as TEMPERATURE_PROBE_CALIBRATE saves it."""

    def parse(self, text: str) -> CoilDrift:
        """Return it."""
        try:
            curves = [_curve(line) for line in text.splitlines() if line.strip()]
        except ValueError:
            raise BadValue from None
        heights = [height for height, _ in curves]
        if len(curves) < LEAST or heights != sorted(set(heights)):
            raise BadValue
        return CoilDrift(tuple(curves))

    def rule(self) -> str:
        """Return what is allowed."""
        return f"{LEAST} or more lines height: a, b, c with rising heights, as saved by a calibration"

    def stand_in(self) -> CoilDrift:
        """Return any drift."""
        return CoilDrift(tuple((height, (3e6 - height, 0.0, 0.0)) for height in HEIGHTS))

    def setting(self, text: str, value: CoilDrift) -> object:
        """Return it as it is written."""
        del value
        return text


def _curve(line: str) -> tuple[float, tuple[float, float, float]]:
    height, _, words = line.partition(":")
    a, b, c = (parse_decimal(word) for word in words.split(","))
    return parse_decimal(height), (a, b, c)
