"""Motor current and speed in the units of the drivers' registers, by the formulas of the data sheets."""

import math
from dataclasses import dataclass
from typing import Final

CLOCK_HZ: Final = 12_000_000.0
"""Of the drivers' own oscillator."""
MICROSTEPS: Final = 256
TSTEP_MAX: Final = 0xFFFFF
_FULL_SCALE_V: Final = {0: 0.325, 1: 0.18}
"""By vsense; of a TMC2209 and a TMC2208."""
_INNER_OHM: Final = 0.02
"""In series with the sense resistor: bond wires and copper."""
_SCALES: Final = 32


@dataclass(frozen=True, slots=True)
class Currents:
    """What the registers have for it."""

    vsense: int
    irun: int
    ihold: int


def current_at(vsense: int, scale: int, sense_ohm: float) -> float:
    """Return A (RMS) at a current scale of 0 to 31.

    TMC2209 data sheet, "Calculation of motor current": (CS+1)/32 · V_FS/(R_sense + 20 mΩ) · 1/√2.
    """
    volts = (scale + 1) / _SCALES * _FULL_SCALE_V[vsense]
    return volts / (sense_ohm + _INNER_OHM) / math.sqrt(2)


def largest_current(sense_ohm: float) -> float:
    """Return the largest A (RMS) that a sense resistor allows."""
    return current_at(0, _SCALES - 1, sense_ohm)


def currents(run_a: float, hold_a: float, sense_ohm: float) -> Currents:
    """Return the settings for a running and a standing motor, A (RMS); RUN_A at most `largest_current`.

    The finer of the two scales is taken where RUN_A lies within it.
    """
    vsense = int(run_a <= current_at(1, _SCALES - 1, sense_ohm))
    return Currents(vsense, _scale(run_a, vsense, sense_ohm), _scale(min(hold_a, run_a), vsense, sense_ohm))


def _scale(amperes: float, vsense: int, sense_ohm: float) -> int:
    one = current_at(vsense, 0, sense_ohm)
    return min(max(math.floor(amperes / one - 1 + 0.5), 0), _SCALES - 1)


def tstep(speed: float, microstep_distance: float, microsteps: int) -> int:
    """Return the register's time between two of the smallest microsteps at SPEED (mm/s).

    MICROSTEP_DISTANCE: mm for one of MICROSTEPS to a full step. 0 stands for a speed that is never reached.
    """
    clocks = CLOCK_HZ * microstep_distance * microsteps / MICROSTEPS / speed
    return min(max(math.floor(clocks + 0.5), 1), TSTEP_MAX)
