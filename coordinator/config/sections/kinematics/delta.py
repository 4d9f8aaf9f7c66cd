"""A linear delta: [printer] delta_radius, and the towers [stepper_a], [stepper_b], [stepper_c]."""

import math

from coordinator.config.options import FloatOption, SectionReader, SectionSpec
from coordinator.config.sections.bounds import length_option
from coordinator.config.sections.homing import HOMING, POSITION_ENDSTOP, read_tower_homing
from coordinator.config.sections.kinematics.frame import Frame, KinematicsKind, home_at_endstops
from coordinator.config.sections.kinematics.towers import (
    MINIMUM_Z,
    ROUND_RANGE_OPTIONS,
    check_directions,
    check_height,
    of_first,
)
from coordinator.config.sections.rails import read_tower
from coordinator.config.sections.reading import Reading
from coordinator.config.sections.steppers import MOTOR
from coordinator.config.unsupported import UNSUPPORTED_STEPPER_OPTIONS
from coordinator.kinematics.delta import MAX_TOWER_SPEED, Delta, Tower

DELTA_RADIUS = length_option(
    "delta_radius", "from a tower's joint to the head's, measured level, with the head in the middle"
)
PRINT_RADIUS = length_option(
    "print_radius",
    "how far from the middle the head may be; by default delta_radius, or less where rods lie too flat",
)
PRINTER = SectionSpec(help="Further options of a delta", options=(DELTA_RADIUS, PRINT_RADIUS, MINIMUM_Z))
ARM_LENGTH = length_option(
    "arm_length", "length of the rods, from joint to joint; by default that of stepper_a"
)
ANGLE = FloatOption(
    name="angle",
    help="direction in which the tower stands, from X towards Y; by default 210 for a, 330 for b, 90 for c",
    unit="°",
    minimum=-360,
    maximum=720,
)
TOWER = SectionSpec(
    help="A tower of a delta. position_endstop is Z of the head in the middle when the endstop switches; by"
    " default that of stepper_a",
    options=(*MOTOR, ARM_LENGTH, ANGLE, *HOMING),
    unsupported=UNSUPPORTED_STEPPER_OPTIONS,
)
WHY = "a delta has the towers stepper_a, stepper_b and stepper_c"
_ANGLES = (210.0, 330.0, 90.0)


def read_delta(reading: Reading, printer: SectionReader) -> Frame:
    """Return the frame of a delta; raises ConfigError."""
    radius, min_z = printer.get(DELTA_RADIUS), printer.get(MINIMUM_Z)
    print_radius = printer.find(PRINT_RADIUS)
    readers = [SectionReader(reading.get(f"stepper_{name}", WHY), TOWER) for name in "abc"]
    a, b, c = (
        _read_tower(reader, readers[0], default, radius)
        for reader, default in zip(readers, _ANGLES, strict=True)
    )
    check_directions(readers, ANGLE, (a.angle, b.angle, c.angle))
    delta = Delta((a, b, c), radius, min_z, print_radius)
    _check_radius(printer, readers[0], delta, reading.config.notes)
    check_height(printer, delta.work_space.high[2], min_z)
    rails = []
    for reader, tower, function in zip(readers, delta.towers, delta.step_functions(), strict=True):
        homing = read_tower_homing(reader, tower.endstop_height, reading.pins)
        rails.append(read_tower(reading, reader, reader.name[-1], function, homing))
    home = home_at_endstops(delta, delta.endstop_positions, readers[0])
    return Frame(delta, tuple(rails), home, range_options=ROUND_RANGE_OPTIONS)


def _read_tower(reader: SectionReader, first: SectionReader, angle: float, radius: float) -> Tower:
    rod, height = (of_first(reader, first, option) for option in (ARM_LENGTH, POSITION_ENDSTOP))
    given = reader.find(ANGLE)
    if rod <= radius:
        raise reader.bad(ARM_LENGTH, f"must be above delta_radius ({radius:g} mm): the rods would not reach")
    return Tower(math.radians(angle if given is None else given), rod, height)


def _check_radius(printer: SectionReader, first: SectionReader, delta: Delta, notes: list[str]) -> None:
    widest = delta.widest_radius
    if widest <= 0:
        raise first.bad(
            ARM_LENGTH,
            f"so short that carriages would be more than {MAX_TOWER_SPEED:g} times as fast as the head even"
            " in the middle; correct it or delta_radius",
        )
    if delta.print_radius is not None and delta.print_radius > widest:
        notes.append(
            f"{printer.place_of(PRINT_RADIUS)}: 'print_radius' of [printer] is {delta.print_radius:g} mm, but"
            f" the rods lie too flat beyond {widest:.5g} mm: moves end there"
        )


DELTA = KinematicsKind(
    Delta, read_delta, PRINTER, reference={"[stepper_a], [stepper_b], [stepper_c] of a delta": TOWER}
)
