"""A deltesian: the towers [stepper_left] and [stepper_right], and [stepper_y]."""

import math

from coordinator.config.options import FloatOption, SectionReader, SectionSpec
from coordinator.config.sections.bounds import length_option
from coordinator.config.sections.homing import HOMING, POSITION_ENDSTOP, read_tower_homing
from coordinator.config.sections.kinematics.frame import (
    Frame,
    KinematicsKind,
    axis_range,
    home_at_endstops,
    home_of,
)
from coordinator.config.sections.kinematics.towers import MINIMUM_Z, check_height, of_first
from coordinator.config.sections.rails import read_rail, read_tower
from coordinator.config.sections.reading import Reading
from coordinator.config.sections.steppers import MOTOR
from coordinator.config.unsupported import UNSUPPORTED_STEPPER_OPTIONS
from coordinator.kinematics.base import linear
from coordinator.kinematics.deltesian import Arm, Deltesian
from coordinator.motion.specs import AXIS_RANGE_OPTIONS

MIN_ANGLE = FloatOption(
    name="min_angle",
    help="smallest angle between a rod and the horizontal, which limits X",
    default=5.0,
    unit="°",
    above=0,
    below=90,
)
PRINT_WIDTH = length_option("print_width", "range of X, centred; by default what min_angle allows")
PRINTER = SectionSpec(
    help="Further options of a deltesian",
    options=(MINIMUM_Z, MIN_ANGLE, PRINT_WIDTH),
    unsupported=("slow_ratio",),
)
ARM_LENGTH = length_option(
    "arm_length", "length of the rod, from joint to joint; by default that of stepper_left"
)
ARM_X_LENGTH = length_option(
    "arm_x_length",
    "level distance between tower and head with the head in the middle; by default that of stepper_left",
)
SIDE = SectionSpec(
    help="A tower of a deltesian. position_endstop is Z of the head in the middle when the endstop switches;"
    " by default that of stepper_left",
    options=(*MOTOR, ARM_LENGTH, ARM_X_LENGTH, *HOMING),
    unsupported=UNSUPPORTED_STEPPER_OPTIONS,
)
WHY = "a deltesian has the towers stepper_left and stepper_right"
RANGE_OPTIONS = (
    "print_width and min_angle of [printer]",
    AXIS_RANGE_OPTIONS[1],
    "minimum_z_position of [printer] and position_endstop of [stepper_left]",
)


def read_deltesian(reading: Reading, printer: SectionReader) -> Frame:
    """Return the frame of a deltesian; raises ConfigError."""
    min_z, min_angle = printer.get(MINIMUM_Z), math.radians(printer.get(MIN_ANGLE))
    width = printer.find(PRINT_WIDTH)
    readers = [SectionReader(reading.get(f"stepper_{side}", WHY), SIDE) for side in ("left", "right")]
    left, right = (
        _read_side(reader, readers[0], sign) for reader, sign in zip(readers, (-1.0, 1.0), strict=True)
    )
    y = read_rail(reading, "y", linear(y=1))
    deltesian = Deltesian(left, right, axis_range(y), min_z, min_angle, width)
    _check_width(printer, readers[0], deltesian)
    check_height(printer, deltesian.work_space.high[2], min_z)
    rails = []
    for reader, arm, function in zip(readers, (left, right), deltesian.step_functions()[:2], strict=True):
        homing = read_tower_homing(reader, arm.endstop_height, reading.pins)
        rails.append(read_tower(reading, reader, reader.name.removeprefix("stepper_"), function, homing))
    home = home_at_endstops(deltesian, (*deltesian.endstop_positions, home_of(y)), readers[0])
    return Frame(deltesian, (*rails, y), home, range_options=RANGE_OPTIONS)


def _read_side(reader: SectionReader, first: SectionReader, sign: float) -> Arm:
    rod, x, height = (
        of_first(reader, first, option) for option in (ARM_LENGTH, ARM_X_LENGTH, POSITION_ENDSTOP)
    )
    if rod <= x:
        raise reader.bad(ARM_LENGTH, f"must be above arm_x_length ({x:g} mm): the rod would not reach")
    return Arm(sign * x, rod, height)


def _check_width(printer: SectionReader, left: SectionReader, deltesian: Deltesian) -> None:
    widest = deltesian.widest
    if widest <= 0:
        raise left.bad(
            ARM_LENGTH,
            "so short that the rod lies below min_angle already with the head in the middle; correct it",
        )
    if deltesian.print_width is not None and deltesian.print_width > 2 * widest:
        raise printer.bad(
            PRINT_WIDTH, f"but rods would lie below min_angle; it can be at most {2 * widest:.5g} mm"
        )


DELTESIAN = KinematicsKind(
    Deltesian,
    read_deltesian,
    PRINTER,
    steppers=("left", "right"),
    reference={"[stepper_left], [stepper_right] of a deltesian": SIDE},
)
