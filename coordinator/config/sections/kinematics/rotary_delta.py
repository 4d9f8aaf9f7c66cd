"""A rotary delta: [printer] shoulder_radius and shoulder_height, and the arms [stepper_a], …_b and …_c."""

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
from coordinator.config.sections.steppers import TURNING_MOTOR
from coordinator.config.unsupported import UNSUPPORTED_STEPPER_OPTIONS
from coordinator.kinematics.rotary_delta import Arm, RotaryDelta

SHOULDER_RADIUS = length_option(
    "shoulder_radius", "radius of the shoulders' circle less that of the joints at the head"
)
SHOULDER_HEIGHT = length_option(
    "shoulder_height", "height of the shoulders above the bed less that of the head's joints above the nozzle"
)
PRINT_RADIUS = length_option(
    "print_radius", "how far from the middle the head may be; by default what gives the largest cylinder"
)
PRINTER = SectionSpec(
    help="Further options of a rotary delta",
    options=(SHOULDER_RADIUS, SHOULDER_HEIGHT, PRINT_RADIUS, MINIMUM_Z),
)
UPPER_LENGTH = length_option(
    "upper_arm_length", "length of the upper arm, from shoulder to elbow; by default that of stepper_a"
)
LOWER_LENGTH = length_option(
    "lower_arm_length", "length of the lower arm, from elbow to head; by default that of stepper_a"
)
ANGLE = FloatOption(
    name="angle",
    help="direction in which the arm stands, from X towards Y; by default 30 for a, 150 for b, 270 for c",
    unit="°",
    minimum=-360,
    maximum=720,
)
ARM = SectionSpec(
    help="An arm of a rotary delta. position_endstop is Z of the head in the middle when the endstop"
    " switches; by default that of stepper_a",
    options=(*TURNING_MOTOR, UPPER_LENGTH, LOWER_LENGTH, ANGLE, *HOMING),
    unsupported=UNSUPPORTED_STEPPER_OPTIONS,
)
WHY = "a rotary delta has the arms stepper_a, stepper_b and stepper_c"
_ANGLES = (30.0, 150.0, 270.0)


def read_rotary_delta(reading: Reading, printer: SectionReader) -> Frame:
    """Return the frame of a rotary delta; raises ConfigError."""
    radius, height = printer.get(SHOULDER_RADIUS), printer.get(SHOULDER_HEIGHT)
    min_z, print_radius = printer.get(MINIMUM_Z), printer.find(PRINT_RADIUS)
    readers = [SectionReader(reading.get(f"stepper_{name}", WHY), ARM) for name in "abc"]
    arms, ends = [], []
    for reader, default in zip(readers, _ANGLES, strict=True):
        arms.append(_read_arm(reader, readers[0], default))
        ends.append(of_first(reader, readers[0], POSITION_ENDSTOP))
    check_directions(readers, ANGLE, tuple(arm.angle for arm in arms))
    machine = RotaryDelta(
        (arms[0], arms[1], arms[2]), radius, height, (ends[0], ends[1], ends[2]), min_z, print_radius
    )
    _check_reach(printer, readers[0], machine)
    rails = []
    for reader, end, function in zip(readers, ends, machine.step_functions(), strict=True):
        homing = read_tower_homing(reader, end, reading.pins)
        rails.append(read_tower(reading, reader, reader.name[-1], function, homing))
    home = home_at_endstops(machine, machine.endstop_positions, readers[0])
    return Frame(machine, tuple(rails), home, range_options=ROUND_RANGE_OPTIONS)


def _read_arm(reader: SectionReader, first: SectionReader, angle: float) -> Arm:
    upper, lower = (of_first(reader, first, option) for option in (UPPER_LENGTH, LOWER_LENGTH))
    given = reader.find(ANGLE)
    return Arm(upper, lower, math.radians(angle if given is None else given))


def _check_reach(printer: SectionReader, first: SectionReader, machine: RotaryDelta) -> None:
    try:
        widest = machine.widest_radius
    except ValueError:
        raise first.bad(
            POSITION_ENDSTOP,
            "where the arms do not reach in the middle; correct it, the arms or the shoulders",
        ) from None
    if widest < 1.0:
        raise printer.bad(
            SHOULDER_HEIGHT,
            f"but then the arms do not reach down to Z {machine.min_z:g} mm; correct it, the arms, or"
            " minimum_z_position",
        )
    if machine.print_radius is not None and machine.print_radius > widest:
        raise printer.bad(
            PRINT_RADIUS, f"but the arms reach only to {widest:.5g} mm from the middle; reduce it"
        )
    check_height(printer, machine.work_space.high[2], machine.min_z)


ROTARY_DELTA = KinematicsKind(
    RotaryDelta,
    read_rotary_delta,
    PRINTER,
    reference={"[stepper_a], [stepper_b], [stepper_c] of a rotary delta": ARM},
)
