"""A polar machine: the turning bed [stepper_bed], the arm [stepper_arm], and [stepper_z]."""

from coordinator.config.model import NO_ENDSTOP
from coordinator.config.options import SectionReader, SectionSpec
from coordinator.config.sections.bounds import MAX_POSITION
from coordinator.config.sections.kinematics.frame import Frame, KinematicsKind, axis_range, home_of
from coordinator.config.sections.rails import POSITION_MAX, read_rail, read_tower
from coordinator.config.sections.reading import Reading
from coordinator.config.sections.steppers import TURNING_MOTOR
from coordinator.config.unsupported import UNSUPPORTED_STEPPER_OPTIONS
from coordinator.kinematics.polar import Polar
from coordinator.motion.specs import AXIS_RANGE_OPTIONS

PRINTER = SectionSpec(
    help="Further options of a polar machine", options=(), unsupported=("max_angular_velocity",)
)
BED = SectionSpec(
    help="The motor that turns the bed of a polar machine",
    options=TURNING_MOTOR,
    unsupported=UNSUPPORTED_STEPPER_OPTIONS,
)
ARM_RANGE = "position_min and position_max of [stepper_arm]"
RANGE_OPTIONS = (ARM_RANGE, ARM_RANGE, AXIS_RANGE_OPTIONS[2])


def read_polar(reading: Reading, _printer: SectionReader) -> Frame:
    """Return the frame of a polar machine; raises ConfigError."""
    turn, radius, up = Polar((0.0, 1.0), (0.0, 1.0)).step_functions()
    section = reading.get("stepper_bed", "a polar machine has stepper_bed, stepper_arm and stepper_z")
    bed = read_tower(reading, SectionReader(section, BED), "bed", turn, NO_ENDSTOP)
    arm, z = read_rail(reading, "arm", radius), read_rail(reading, "z", up)
    low, high = axis_range(arm)
    if not 0 < high <= MAX_POSITION:
        option = reading.config.sections["stepper_arm"]
        rule = f"must be above 0 and at most {MAX_POSITION:.15g}"
        raise SectionReader(option, SectionSpec("", ()), whole=False).bad(POSITION_MAX, rule)
    home = (home_of(arm), 0.0, home_of(z))
    return Frame(Polar((low, high), axis_range(z)), (bed, arm, z), home, range_options=RANGE_OPTIONS)


POLAR = KinematicsKind(
    Polar, read_polar, PRINTER, steppers=("bed", "arm"), reference={"[stepper_bed] of a polar machine": BED}
)
