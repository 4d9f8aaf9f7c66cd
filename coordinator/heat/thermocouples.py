"""Thermocouple amplifiers with an analog output: AD595, AD597, AD8494 to AD8497.

The voltage of a thermocouple against 0 °C follows the polynomials of IEC 60584-1 (NIST Monograph 175). What
the amplifiers make of it is in their data sheets: AD594/595 (gain 247.3, input offset 11 µV), AD596/597
(245.46 for type K), AD8494 to AD8497 with application note AN-1087 (gain 96.7 and 90.35 for J, 122.4 for K;
trimmed to 5 mV/K at 25 °C, or at 60 °C for AD8496 and AD8497).
"""

import math
from collections.abc import Callable
from typing import Final

from coordinator.heat.sensors import Voltage

STEP_C: Final = 10
HIGHEST_J_C: Final = 760
HIGHEST_K_C: Final = 1370

_J: Final = (
    0.0,
    5.0381187815e-2,
    3.0475836930e-5,
    -8.5681065720e-8,
    1.3228195295e-10,
    -1.7052958337e-13,
    2.0948090697e-16,
    -1.2538395336e-19,
    1.5631725697e-23,
)
_K: Final = (
    -1.7600413686e-2,
    3.8921204975e-2,
    1.8558770032e-5,
    -9.9457592874e-8,
    3.1840945719e-10,
    -5.6072844889e-13,
    5.6075059059e-16,
    -3.2020720003e-19,
    9.7151147152e-23,
    -1.2104721275e-26,
)
_K_BUMP: Final = (0.1185976, -1.183432e-4, 126.9686)


def type_j_mv(celsius: float) -> float:
    """Return the voltage of a type J thermocouple against 0 °C, 0..760 °C."""
    return _polynomial(_J, celsius)


def type_k_mv(celsius: float) -> float:
    """Return the voltage of a type K thermocouple against 0 °C, 0..1372 °C."""
    height, width, centre = _K_BUMP
    return _polynomial(_K, celsius) + height * math.exp(width * (celsius - centre) ** 2)


def _polynomial(coefficients: tuple[float, ...], x: float) -> float:
    return sum(c * x**power for power, c in enumerate(coefficients))


def amplifier(name: str, adc_v: float, offset_v: float) -> Voltage:
    """Return the sensor of amplifier NAME (a key of AMPLIFIERS)."""
    voltage, highest_c = AMPLIFIERS[name]
    points = [(float(c), voltage(c)) for c in range(0, highest_c + 1, STEP_C)]
    return Voltage.from_points(points, adc_v, offset_v)


def _trimmed(millivolts: Callable[[float], float], gain: float, trim_c: float) -> Callable[[float], float]:
    """Return the output of an AD849x in V: 5 mV/K at the temperature it is trimmed at."""
    return lambda c: 0.005 * trim_c + gain * (millivolts(c) - millivolts(trim_c)) / 1000


AMPLIFIERS: Final[dict[str, tuple[Callable[[float], float], int]]] = {
    "AD595": (lambda c: 247.3 * (type_k_mv(c) + 0.011) / 1000, HIGHEST_K_C),
    "AD597": (lambda c: 245.46 * type_k_mv(c) / 1000, HIGHEST_K_C),
    "AD8494": (_trimmed(type_j_mv, 96.7, 25), HIGHEST_J_C),
    "AD8495": (_trimmed(type_k_mv, 122.4, 25), HIGHEST_K_C),
    "AD8496": (_trimmed(type_j_mv, 90.35, 60), HIGHEST_J_C),
    "AD8497": (_trimmed(type_k_mv, 122.4, 60), HIGHEST_K_C),
}
"""By name: output in V at a temperature with the board at 25 °C, and the highest temperature."""
