"""What kinematics with towers or arms around the bed share: options and checks."""

import math
from typing import TypeVar

from coordinator.config.options import FloatOption, Option, SectionReader
from coordinator.config.sections.bounds import position_option

MINIMUM_Z = position_option("minimum_z_position", "lowest Z that the head may go to", 0.0)
ROUND_RANGE_OPTIONS = (
    "print_radius of [printer]",
    "print_radius of [printer]",
    "minimum_z_position of [printer] and position_endstop of [stepper_a]",
)
"""What says how far X, Y and Z may go where carriages or arms stand around the bed."""
_TOO_CLOSE_DEG = 30.0


T = TypeVar("T")


def of_first(reader: SectionReader, first: SectionReader, option: Option[T]) -> T:
    """Return an option of a tower or an arm, where it is absent that of the FIRST one; raises ConfigError."""
    own = reader.find(option)
    return first.get(option) if own is None else own


def check_directions(
    readers: list[SectionReader], angle_option: FloatOption, angles: tuple[float, ...]
) -> None:
    """Refuse two towers or arms that stand in nearly the same direction; raises ConfigError."""
    for i, reader in enumerate(readers):
        for other in range(i):
            apart = abs(math.degrees(math.remainder(angles[i] - angles[other], math.tau)))
            if apart < _TOO_CLOSE_DEG:
                raise reader.bad(
                    angle_option,
                    f"only {apart:.3g}° away from [{readers[other].name}]; they must be {_TOO_CLOSE_DEG:g}°"
                    " apart at least",
                )


def check_height(printer: SectionReader, top: float, min_z: float) -> None:
    """Refuse a machine whose head has no room up and down; raises ConfigError."""
    if top <= min_z:
        raise printer.bad(
            MINIMUM_Z,
            f"but at the rim the head reaches only up to Z {top:.5g} mm, which leaves no room above"
            f" {min_z:g} mm; correct the lengths, position_endstop and print_radius",
        )
