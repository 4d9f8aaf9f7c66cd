"""Resistors that measure a temperature: NTC thermistors, platinum, tables. Both ways, °C to Ω and back.

Every function is total over positive resistances: beyond the range of the part it goes on as the formula
does, so that a broken sensor reads as absurdly cold or hot and never as an exception.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, Protocol

from coordinator.heat.tables import Line, TableError
from nodes.support.errors import CanductorError

ZERO_C: Final = 273.15
"""0 °C in K."""
MIN_OHMS: Final = 1e-3
HOTTEST_C: Final = 10_000.0
COLDEST_C: Final = -273.0


class SensorError(CanductorError):
    """Values given for a sensor describe none; the sentence says which and why."""


class Resistor(Protocol):
    """A resistance as a function of temperature."""

    def ohms(self, celsius: float, /) -> float:
        """Return the resistance at a temperature."""
        ...

    def celsius(self, ohms: float, /) -> float:
        """Return the temperature at a resistance."""
        ...


@dataclass(frozen=True, slots=True)
class SteinhartHart:
    """An NTC thermistor by 1/T = A + B ln R + C (ln R)³, T in K, R in Ω; B above and C not below 0."""

    a: float
    b: float
    c: float

    def __post_init__(self) -> None:
        if not (self.b > 0 and self.c >= 0 and math.isfinite(self.a)):
            raise SensorError(
                "these Steinhart-Hart coefficients are those of no NTC thermistor: b must be > 0"
            )

    @classmethod
    def from_beta(cls, celsius: float, ohms: float, beta: float) -> "SteinhartHart":
        """Return the thermistor of OHMS at CELSIUS whose B value is BETA, in K."""
        if not (ohms > 0 and beta > 0 and celsius > -ZERO_C):
            raise SensorError("a thermistor by beta needs a resistance and a beta above 0")
        b = 1 / beta
        return cls(1 / (celsius + ZERO_C) - b * math.log(ohms), b, 0.0)

    @classmethod
    def from_points(cls, points: Sequence[tuple[float, float]]) -> "SteinhartHart":
        """Return the thermistor through three points (°C, Ω), in any order.

        Where no thermistor goes through all three (C would be negative, as measured points may have it), the
        one by beta through the outer two. Raises SensorError for points that do not fall.
        """
        cold, middle, hot = sorted(points)
        if not (cold[0] < middle[0] < hot[0] and cold[1] > middle[1] > hot[1] > 0 and cold[0] > -ZERO_C):
            raise SensorError("the resistance of a thermistor's three points must fall as temperature rises")
        inverse = [1 / (celsius + ZERO_C) for celsius, _ in (cold, middle, hot)]
        log = [math.log(ohms) for _, ohms in (cold, middle, hot)]
        slope_cold = (inverse[1] - inverse[0]) / (log[1] - log[0])
        slope_hot = (inverse[2] - inverse[0]) / (log[2] - log[0])
        c = (slope_hot - slope_cold) / (log[2] - log[1]) / sum(log)
        b = slope_cold - c * (log[0] ** 2 + log[0] * log[1] + log[1] ** 2)
        if c < 0 or b <= 0:
            beta = (log[2] - log[0]) / (inverse[2] - inverse[0])
            return cls.from_beta(*hot, beta)
        return cls(inverse[0] - b * log[0] - c * log[0] ** 3, b, c)

    def ohms(self, celsius: float) -> float:
        """Return the resistance; Cardano's formula, which has one real solution as B and C are positive."""
        lack = self.a - 1 / (max(celsius, COLDEST_C) + ZERO_C)
        if self.c == 0:
            return math.exp(min(-lack / self.b, 700.0))
        half = lack / self.c / 2
        root = math.hypot(math.sqrt((self.b / self.c / 3) ** 3), half)
        return math.exp(min(math.cbrt(root - half) - math.cbrt(root + half), 700.0))

    def celsius(self, ohms: float) -> float:
        """Return the temperature."""
        log = math.log(max(ohms, MIN_OHMS))
        inverse = self.a + self.b * log + self.c * log**3
        return HOTTEST_C if inverse <= 1 / (HOTTEST_C + ZERO_C) else 1 / inverse - ZERO_C


@dataclass(frozen=True, slots=True)
class Platinum:
    """A platinum resistor of ZERO_OHMS at 0 °C by Callendar and Van Dusen, coefficients of IEC 60751."""

    zero_ohms: float

    def ohms(self, celsius: float) -> float:
        """Return the resistance."""
        cubic = _PT_C * (celsius - 100) * celsius**3 if celsius < 0 else 0.0
        return self.zero_ohms * (1 + _PT_A * celsius + _PT_B * celsius**2 + cubic)

    def celsius(self, ohms: float) -> float:
        """Return the temperature."""
        ratio = max(ohms, 0.0) / self.zero_ohms
        radicand = _PT_A**2 - 4 * _PT_B * (1 - ratio)
        celsius = (math.sqrt(max(radicand, 0.0)) - _PT_A) / (2 * _PT_B)
        if celsius >= 0:
            return celsius
        for _ in range(8):  # Newton from the formula for above zero: at -200 °C it is 2.4 K off
            slope = _PT_A + 2 * _PT_B * celsius + _PT_C * (4 * celsius**3 - 300 * celsius**2)
            celsius -= (self.ohms(celsius) / self.zero_ohms - ratio) / slope
        return max(celsius, COLDEST_C)


_PT_A: Final = 3.9083e-3
_PT_B: Final = -5.775e-7
_PT_C: Final = -4.183e-12


@dataclass(frozen=True, slots=True)
class ResistanceTable:
    """A resistor measured at some temperatures; straight lines between and beyond them."""

    line: Line
    """°C to Ω."""

    @classmethod
    def from_points(cls, points: Sequence[tuple[float, float]]) -> "ResistanceTable":
        """Return the resistor through two or more points (°C, Ω); SensorError when they turn back."""
        try:
            return cls(Line.through(points))
        except TableError as error:
            raise SensorError(f"resistances over temperatures: {error}") from None

    def ohms(self, celsius: float) -> float:
        """Return the resistance."""
        return max(self.line.at(celsius), MIN_OHMS)

    def celsius(self, ohms: float) -> float:
        """Return the temperature."""
        return self.line.where(ohms)
