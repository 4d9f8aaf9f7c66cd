"""What towers and arms have to keep to, whatever their kinematics."""

import math

from coordinator.config.options import FloatOption, SectionReader
from coordinator.config.sections.kinematics.printer_options import MINIMUM_Z

_TOO_CLOSE_DEG = 30.0


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
