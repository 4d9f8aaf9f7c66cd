"""What an analog input sees of a temperature: its circuit, and the numbers a node gets and is limited to.

A *ratio* is what the converter reads as a part of its reference voltage, 0 to 1.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, Protocol

from coordinator.heat.resistors import MIN_OHMS, Resistor, SensorError
from coordinator.heat.tables import Line, TableError

RAIL: Final = 1e-6
"""A ratio nearer to 0 or 1 than this is taken as this near: wires that are open or touch."""


class Sensor(Protocol):
    """A temperature as an analog input sees it; total in both directions."""

    def ratio(self, celsius: float, /) -> float:
        """Return what the converter reads at a temperature, 0 to 1."""
        ...

    def celsius(self, ratio: float, /) -> float:
        """Return the temperature that makes the converter read RATIO."""
        ...


@dataclass(frozen=True, slots=True)
class PullUp:
    """RESISTOR to ground with INLINE_OHMS in its line, and PULLUP_OHMS to the reference voltage."""

    resistor: Resistor
    pullup_ohms: float = 4700.0
    inline_ohms: float = 0.0

    def __post_init__(self) -> None:
        if not (self.pullup_ohms > 0 and self.inline_ohms >= 0):
            raise SensorError("a pull-up resistor must be above 0 Ω and one in the line not below")

    def ratio(self, celsius: float) -> float:
        """Return what the converter reads."""
        lower = self.inline_ohms + self.resistor.ohms(celsius)
        return _within_rails(lower / (lower + self.pullup_ohms))

    def celsius(self, ratio: float) -> float:
        """Return the temperature."""
        ratio = _within_rails(ratio)
        ohms = self.pullup_ohms * ratio / (1 - ratio) - self.inline_ohms
        return self.resistor.celsius(max(ohms, MIN_OHMS))


@dataclass(frozen=True, slots=True)
class AmplifiedPullUp:
    """RESISTOR below PULLUP_OHMS at SUPPLY_V, its voltage times GAIN at a converter for ADC_V."""

    resistor: Resistor
    pullup_ohms: float
    supply_v: float
    gain: float
    adc_v: float

    def ratio(self, celsius: float) -> float:
        """Return what the converter reads."""
        ohms = self.resistor.ohms(celsius)
        return _within_rails(self._scale * ohms / (ohms + self.pullup_ohms))

    def celsius(self, ratio: float) -> float:
        """Return the temperature."""
        part = min(_within_rails(ratio) / self._scale, 1 - RAIL)
        return self.resistor.celsius(self.pullup_ohms * part / (1 - part))

    @property
    def _scale(self) -> float:
        return self.supply_v * self.gain / self.adc_v


@dataclass(frozen=True, slots=True)
class Voltage:
    """A voltage that follows the temperature by LINE (°C to V), OFFSET_V added, at a converter for ADC_V."""

    line: Line
    adc_v: float = 5.0
    offset_v: float = 0.0

    @classmethod
    def from_points(
        cls, points: Sequence[tuple[float, float]], adc_v: float = 5.0, offset_v: float = 0.0
    ) -> "Voltage":
        """Return the sensor through two or more points (°C, V); SensorError when they turn back."""
        if not adc_v > 0:
            raise SensorError("the converter's reference voltage must be above 0 V")
        try:
            return cls(Line.through(points), adc_v, offset_v)
        except TableError as error:
            raise SensorError(f"voltages over temperatures: {error}") from None

    def ratio(self, celsius: float) -> float:
        """Return what the converter reads."""
        return _within_rails((self.line.at(celsius) + self.offset_v) / self.adc_v)

    def celsius(self, ratio: float) -> float:
        """Return the temperature."""
        return self.line.where(_within_rails(ratio) * self.adc_v - self.offset_v)


def _within_rails(ratio: float) -> float:
    return min(max(ratio, RAIL), 1 - RAIL)


@dataclass(frozen=True, slots=True)
class RatioRange:
    """What a converter may read while a sensor is in order."""

    low: float
    high: float


def ratio_range(sensor: Sensor, min_c: float, max_c: float) -> RatioRange:
    """Return what SENSOR may read between two temperatures; SensorError when it cannot tell them apart.

    At either end the range leaves out what an open and what a shorted line read, whatever the temperatures:
    both have to stop a heater.
    """
    if not min_c < max_c:
        raise SensorError(f"min_temp ({min_c:g} °C) must be below max_temp ({max_c:g} °C)")
    low, high = sorted((sensor.ratio(min_c), sensor.ratio(max_c)))
    if not low < high or math.isnan(low + high):
        raise SensorError(
            f"the sensor reads the same at min_temp ({min_c:g} °C) and max_temp ({max_c:g} °C); "
            "correct its type or these"
        )
    return RatioRange(max(low, OPEN_OR_SHORT), min(high, 1 - OPEN_OR_SHORT))


OPEN_OR_SHORT: Final = 1 / 4096
"""Within one step of a 12-bit converter from its rails a line is broken."""
