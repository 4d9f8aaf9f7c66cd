"""[dual_carriage]: a second carriage on X or Y."""

from collections.abc import Sequence
from dataclasses import replace

from coordinator.config.errors import ConfigError
from coordinator.config.model import DualCarriageDescription, RailDescription, StepperDescription
from coordinator.config.options import ChoiceOption, FloatOption, SectionReader, SectionSpec, one_of
from coordinator.config.sections.bounds import MAX_POSITION
from coordinator.config.sections.homing import WAITING
from coordinator.config.sections.kinematics.frame import Frame, axis_range, home_of
from coordinator.config.sections.rails import RAIL, read_axis
from coordinator.config.sections.reading import Reading
from coordinator.kinematics.base import StepFunction
from coordinator.kinematics.dual_carriage import Carriage, DualCarriage

AXIS = ChoiceOption(name="axis", help="the axis on which the second carriage runs", choices=("x", "y"))
SAFE_DISTANCE = FloatOption(
    name="safe_distance",
    help="what the carriages keep between their positions; 0: they may pass each other; by default the"
    " smaller one of the distances between both position_min and between both position_max",
    unit="mm",
    minimum=0,
    maximum=MAX_POSITION,
)
DUAL_CARRIAGE = SectionSpec(
    help="The second carriage of a machine with two (IDEX), parked at start; as a rail, and",
    options=(AXIS, SAFE_DISTANCE, *RAIL.options),
    unsupported=RAIL.unsupported,
)


def read_dual_carriage(reading: Reading, frame: Frame, possible: Sequence[str]) -> Frame:
    """Return the frame with the second carriage of [dual_carriage]; raises ConfigError.

    POSSIBLE: the kinematics that have a place for one, for the message.
    """
    kinematics = frame.kinematics
    section = reading.config.sections["dual_carriage"]
    if not kinematics.second_carriages:
        raise ConfigError(
            section.place,
            f"kinematics {kinematics.name} has no place for [dual_carriage]; it needs"
            f" {one_of(tuple(possible))}, or generic_cartesian with [dual_carriage NAME]",
        )
    reading.used.add(section.name)
    reader = SectionReader(section, DUAL_CARRIAGE)
    letter = reader.get(AXIS)
    function = kinematics.second_carriages.get(letter)
    if function is None:
        raise reader.bad(AXIS, f"but kinematics {kinematics.name} can have a second carriage on x only")
    axis = "xyz".index(letter)
    first = frame.rails[axis]
    second = read_axis(reading, reader, letter, function)
    dual = describe_dual(reader, axis, (first, first.steppers), (second, second.steppers), ("0", "1"))
    reading.finish(reader, waiting=WAITING if second.homing.waits else ())
    return park(frame, dual, second.steppers, reader.name)


def park(
    frame: Frame, dual: DualCarriageDescription, steppers: tuple[StepperDescription, ...], section: str
) -> Frame:
    """Return the frame with a second carriage, that of SECTION, which stands still at start."""
    weights = dual.carriages.weights(dual.carriages.home)
    parked = tuple(
        replace(stepper, function=StepFunction(weights=weights[stepper.name])) for stepper in steppers
    )
    dual = replace(dual, rails=(dual.rails[0], replace(dual.rails[1], steppers=parked)))
    options = [
        f"{text}, or those and safe_distance of [{section}]" if axis == dual.carriages.axis else text
        for axis, text in enumerate(frame.range_options)
    ]
    return replace(
        frame,
        motors=(*frame.steppers, *parked),
        dual_carriage=dual,
        range_options=(options[0], options[1], options[2]),
    )


def describe_dual(
    reader: SectionReader,
    axis: int,
    first: tuple[RailDescription, tuple[StepperDescription, ...]],
    second: tuple[RailDescription, tuple[StepperDescription, ...]],
    names: tuple[str, str],
) -> DualCarriageDescription:
    """Return both carriages, each a rail and the steppers that move it; READER's section is the second's.

    NAMES: as status reports call them.
    """
    ranges = [axis_range(rail) for rail, _ in (first, second)]
    given = reader.find(SAFE_DISTANCE)
    usual = min(abs(ranges[0][0] - ranges[1][0]), abs(ranges[0][1] - ranges[1][1]))
    pairs = zip((first, second), names, strict=True)
    one, two = (_carriage(rail, steppers, name) for (rail, steppers), name in pairs)
    speed_mm_s = first[0].homing.speed
    dual = DualCarriage(axis, (one, two), usual if given is None else given, speed_mm_s)
    if abs(one.home - two.home) < dual.safe_distance:
        raise reader.bad(
            SAFE_DISTANCE,
            f"but after homing the carriages are {abs(one.home - two.home):g} mm apart, less than"
            f" {dual.safe_distance:g} mm; correct safe_distance, or position_endstop of one of them",
        )
    return DualCarriageDescription((first[0], second[0]), dual)


def _carriage(rail: RailDescription, steppers: tuple[StepperDescription, ...], name: str) -> Carriage:
    low, high = axis_range(rail)
    weights = tuple((stepper.name, stepper.weights) for stepper in steppers)
    return Carriage(low, high, home_of(rail), weights, name)
