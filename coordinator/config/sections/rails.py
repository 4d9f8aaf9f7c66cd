"""Rails along an axis: the range, the endstop, and all steppers that move it."""

from dataclasses import dataclass

from coordinator.config.model import NO_ENDSTOP, HomingDescription, RailDescription, StepperDescription
from coordinator.config.options import FloatOption, SectionReader, SectionSpec
from coordinator.config.sections.bounds import MAX_BELT_POSITION, MAX_POSITION, position_option
from coordinator.config.sections.homing import ENDSTOP_PIN, HOMING, WAITING, read_endstop, read_homing
from coordinator.config.sections.reading import Reading, SecondEndstop
from coordinator.config.sections.steppers import MOTOR, TURNING_MOTOR, extra_sections, read_stepper
from coordinator.config.unsupported import UNSUPPORTED_STEPPER_OPTIONS
from coordinator.kinematics.base import StepFunction


@dataclass(frozen=True, slots=True, kw_only=True)
class _UpperEnd(FloatOption):
    """The end of a range."""

    def stand_in(self) -> float:
        """Return the furthest: positions are not checked against a range that is missing."""
        return MAX_POSITION


POSITION_MIN = position_option("position_min", "lowest position of the axis", 0.0)
POSITION_MAX = _UpperEnd(
    name="position_max",
    help="highest position of the axis",
    unit="mm",
    minimum=-MAX_POSITION,
    maximum=MAX_BELT_POSITION,
)
RANGE = (POSITION_MIN, POSITION_MAX)
RAIL = SectionSpec(
    help="The first stepper of an axis, with the axis' range and its homing",
    options=(*MOTOR, *RANGE, *HOMING),
    unsupported=UNSUPPORTED_STEPPER_OPTIONS,
)
EXTRA_STEPPER = SectionSpec(
    help="A further stepper of an axis, tower or arm: stepper_z1, …; one of an axis that no other rail moves"
    " may have an endstop of its own",
    options=(*MOTOR, ENDSTOP_PIN),
)
EXTRA_TURNING_STEPPER = SectionSpec(help=EXTRA_STEPPER.help, options=(*TURNING_MOTOR, ENDSTOP_PIN))

EVERY_AXIS = "every axis needs its stepper"


def read_rail(reading: Reading, axis: str, function: StepFunction) -> RailDescription:
    """Return the rail of [stepper_AXIS] with all its steppers; raises ConfigError."""
    reader = SectionReader(reading.get(f"stepper_{axis}", EVERY_AXIS), RAIL)
    rail = read_axis(reading, reader, axis, function)
    reading.finish(reader, waiting=WAITING if rail.homing.waits else ())
    return rail


def read_axis(reading: Reading, reader: SectionReader, axis: str, function: StepFunction) -> RailDescription:
    """Return a rail whose section is read by READER, which the caller finishes; raises ConfigError."""
    first = read_stepper(reader, function, reading.pins)
    low, high = read_range(reader)
    homing = read_homing(reader, low, high, reading.pins)
    further = read_extra_steppers(reading, reader.name, function)
    return RailDescription(axis, (first, *further), low, high, homing, reader.place)


def read_tower(
    reading: Reading, reader: SectionReader, name: str, function: StepFunction, homing: HomingDescription
) -> RailDescription:
    """Return the rail NAME of a tower, an arm or a winch, whose range follows from the kinematics.

    READER, of the section of its first stepper, is finished. Raises ConfigError.
    """
    steppers = (
        read_stepper(reader, function, reading.pins),
        *read_extra_steppers(reading, reader.name, function),
    )
    reading.finish(reader, waiting=WAITING if homing.waits or homing is NO_ENDSTOP else ())
    return RailDescription(name, steppers, None, None, homing, reader.place)


def read_range(reader: SectionReader) -> tuple[float, float]:
    """Return how far a rail goes, mm; raises ConfigError."""
    low, high = reader.get(POSITION_MIN), reader.get(POSITION_MAX)
    if high <= low:
        raise reader.bad(POSITION_MAX, f"must be above position_min ({low:g} mm)")
    return low, high


def read_extra_steppers(
    reading: Reading, name: str, function: StepFunction
) -> tuple[StepperDescription, ...]:
    """Return the further steppers of the rail whose first one is [NAME]; raises ConfigError."""
    further = []
    for section in extra_sections(reading, name):
        reader = SectionReader(section, EXTRA_TURNING_STEPPER if function.turns else EXTRA_STEPPER)
        further.append(read_stepper(reader, function, reading.pins))
        virtual = ""
        if reader.has(ENDSTOP_PIN):
            pin, virtual = read_endstop(reader, reading.pins)
            if pin is not None:
                reading.second_endstops[reader.name] = SecondEndstop(reader.name, reader.place, pin, virtual)
                virtual = ""  # it acts
        reading.finish(reader, waiting=WAITING if virtual else ())
    return tuple(further)
