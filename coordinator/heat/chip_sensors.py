"""The temperature sensor inside a micro-controller, by its chip: from the makers' data sheets.

All are lines from voltage to temperature, with the converter's reference taken as 3.3 V. What a data sheet
gives is typical: single chips are up to some 10 °C off. Chips that were measured at the factory have
two points in their memory; these are taken if they make sense.

=============  =====================================================================================
chip           source: temperature and voltage, slope; addresses of the factory's two points
=============  =====================================================================================
stm32f0        STM32F072x8/xB data sheet, "Temperature sensor characteristics" and "calibration values"
stm32f1        STM32F103xC/D/E data sheet, "TS characteristics"
stm32f2        STM32F20x data sheet, "Temperature sensor characteristics"
stm32f4        STM32F405/407 data sheet, the same two tables
stm32g0        STM32G0B1 data sheet, the same two tables; measured at 3.0 V
stm32g4        STM32G474 data sheet, the same two tables; measured at 3.0 V
stm32l4        STM32L412 data sheet, the same two tables; measured at 3.0 V
stm32h7        STM32H743 and STM32H723 data sheets, the same two tables; points of 16 bits
rp2040, rp2350 RP2040 data sheet 4.9.5, RP2350 data sheet 12.4.6: T = 27 - (V - 0.706) / 0.001721
sam3x, sam4e   SAM3X/A and SAM4E data sheets, "Temperature Sensor"
=============  =====================================================================================
"""

from dataclasses import dataclass
from typing import Final

REFERENCE_V: Final = 3.3
SLOPE_TRUST: Final = 0.35
"""Points of the factory whose slope is farther from the typical one, as a part of it, are not taken."""
PLACE_TRUST_K: Final = 60.0
"""The same of the temperature they give where the data sheet has its typical one."""


@dataclass(frozen=True, slots=True)
class FactoryPoints:
    """Where a chip keeps two measurements of its factory: half words of so many BITS, taken at VOLTS."""

    first: int
    first_c: float
    second: int
    second_c: float
    volts: float = REFERENCE_V
    bits: int = 12


@dataclass(frozen=True, slots=True)
class ChipSensor:
    """What a chip's sensor gives: VOLTS at CELSIUS, VOLTS_PER_K more for each kelvin."""

    celsius_at: float
    volts: float
    volts_per_k: float
    factory: FactoryPoints | None = None

    def line(self) -> "ChipLine":
        """Return the typical line."""
        slope = self.volts_per_k / REFERENCE_V
        return ChipLine(self.celsius_at, self.volts / REFERENCE_V, 1 / slope)

    def corrected(self, first: int, second: int) -> "ChipLine | None":
        """Return the line through what the factory measured; None where that makes no sense."""
        factory = self.factory
        if factory is None or first == second:
            return None
        full = (2**factory.bits - 1) * REFERENCE_V / factory.volts
        line = ChipLine.through(factory.first_c, first / full, factory.second_c, second / full)
        typical = self.line()
        steep = abs(line.k_per_ratio / typical.k_per_ratio - 1) <= SLOPE_TRUST
        near = abs(line.celsius(typical.ratio_at) - typical.celsius_at) <= PLACE_TRUST_K
        return line if steep and near else None


@dataclass(frozen=True, slots=True)
class ChipLine:
    """The temperature by what the converter reads, 0 to 1: CELSIUS_AT where it reads RATIO_AT."""

    celsius_at: float
    ratio_at: float
    k_per_ratio: float

    @staticmethod
    def through(first_c: float, first: float, second_c: float, second: float) -> "ChipLine":
        """Return the line through two points that differ."""
        return ChipLine(first_c, first, (second_c - first_c) / (second - first))

    def celsius(self, ratio: float) -> float:
        """Return the temperature."""
        return self.celsius_at + (ratio - self.ratio_at) * self.k_per_ratio


_RP2: Final = ChipSensor(27.0, 0.706, -0.001721)
_AT_3V: Final = FactoryPoints(0x1FFF75A8, 30.0, 0x1FFF75CA, 130.0, volts=3.0)
CHIPS: Final[dict[str, ChipSensor]] = {
    "stm32f0": ChipSensor(30.0, 1.43, -0.0043, FactoryPoints(0x1FFFF7B8, 30.0, 0x1FFFF7C2, 110.0)),
    "stm32f1": ChipSensor(25.0, 1.43, -0.0043),
    "stm32f2": ChipSensor(25.0, 0.76, 0.0025),
    "stm32f4": ChipSensor(25.0, 0.76, 0.0025, FactoryPoints(0x1FFF7A2C, 30.0, 0x1FFF7A2E, 110.0)),
    "stm32g0": ChipSensor(30.0, 0.76, 0.0025, _AT_3V),
    "stm32g4": ChipSensor(30.0, 0.76, 0.0025, _AT_3V),
    "stm32l4": ChipSensor(30.0, 0.76, 0.0025, _AT_3V),
    "stm32h7": ChipSensor(30.0, 0.62, 0.002, FactoryPoints(0x1FF1E820, 30.0, 0x1FF1E840, 110.0, bits=16)),
    "rp2040": _RP2,
    "rp2350": _RP2,
    "sam3x": ChipSensor(27.0, 0.8, 0.00265),
    "sam4e": ChipSensor(27.0, 1.44, 0.0047),
    "virtual-": _RP2,
}
"""By what the names of chips begin with."""


def chip_sensor(mcu: str) -> ChipSensor | None:
    """Return the sensor of the chip that a node's dictionary calls MCU; None where it is not known."""
    return next((sensor for prefix, sensor in CHIPS.items() if mcu.startswith(prefix)), None)
