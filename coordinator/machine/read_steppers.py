"""What every stepper section has in common, and the rails of the axes."""

import re
from collections.abc import Iterator

from coordinator.machine.config_file import ConfigFile, RawSection
from coordinator.machine.model import HomingDescription, NotYetActing, RailDescription, StepperDescription
from coordinator.machine.options import (
    BoolOption,
    FloatOption,
    GearRatioOption,
    IntOption,
    SectionReader,
    SectionSpec,
)
from coordinator.machine.pins import PinDescription, PinOption, PinRegistry
from coordinator.machine.problem import ConfigError, Place
from coordinator.machine.read_printer import MAX_SPEED
from coordinator.machine.well_known import LATER_STEPPER_OPTIONS

MAX_POSITION = 100_000.0
"""mm: a hundred metres; positions stay exact to far below a step."""

STEP_PIN = PinOption(name="step_pin", help="the driver's step input")
DIR_PIN = PinOption(name="dir_pin", help="the driver's direction input; ! when high means negative")
ENABLE_PIN = PinOption(name="enable_pin", help="the driver's enable input; may be shared", share="enable")
MICROSTEPS = IntOption(name="microsteps", help="microsteps the driver is set to", minimum=1, maximum=256)
ROTATION_DISTANCE = FloatOption(
    name="rotation_distance",
    help="way of the axis for one turn of the motor, or of the last gear",
    unit="mm",
    above=0,
    maximum=10_000,
)
FULL_STEPS = IntOption(
    name="full_steps_per_rotation",
    help="full steps of the motor: 200 for 1.8°, 400 for 0.9°",
    default=200,
    minimum=4,
    maximum=10_000,
    multiple_of=4,
)
GEAR_RATIO = GearRatioOption(name="gear_ratio", help="gears between motor and axis", default=1.0)
STEP_PULSE = FloatOption(
    name="step_pulse_duration",
    help="shortest high time of the step pin; 0 for a driver that is set to step on both edges",
    default=2e-6,
    unit="s",
    minimum=0,
    maximum=0.001,
)
MOTOR = (STEP_PIN, DIR_PIN, ENABLE_PIN, MICROSTEPS, ROTATION_DISTANCE, FULL_STEPS, GEAR_RATIO, STEP_PULSE)

ENDSTOP_PIN = PinOption(name="endstop_pin", help="the endstop's input", pullable=True, share="endstop")
POSITION_MIN = FloatOption(
    name="position_min",
    help="lowest position of the axis",
    default=0.0,
    unit="mm",
    minimum=-MAX_POSITION,
    maximum=MAX_POSITION,
)
POSITION_MAX = FloatOption(
    name="position_max",
    help="highest position of the axis",
    unit="mm",
    minimum=-MAX_POSITION,
    maximum=MAX_POSITION,
)
POSITION_ENDSTOP = FloatOption(
    name="position_endstop",
    help="where the axis is when the endstop switches",
    unit="mm",
    minimum=-MAX_POSITION,
    maximum=MAX_POSITION,
)
HOMING_SPEED = FloatOption(
    name="homing_speed",
    help="speed towards the endstop",
    default=5.0,
    unit="mm/s",
    above=0,
    maximum=MAX_SPEED,
)
SECOND_HOMING_SPEED = FloatOption(
    name="second_homing_speed",
    help="speed of the second approach; by default half of homing_speed",
    unit="mm/s",
    above=0,
    maximum=MAX_SPEED,
)
RETRACT_DISTANCE = FloatOption(
    name="homing_retract_dist",
    help="way back before the second approach; 0: no second approach",
    default=5.0,
    unit="mm",
    minimum=0,
    maximum=MAX_POSITION,
)
RETRACT_SPEED = FloatOption(
    name="homing_retract_speed",
    help="speed of the way back; by default homing_speed",
    unit="mm/s",
    above=0,
    maximum=MAX_SPEED,
)
POSITIVE_DIR = BoolOption(
    name="homing_positive_dir",
    help="whether the endstop is at the upper end; by default the end that is nearer to position_endstop",
)
RAIL = SectionSpec(
    help="The first stepper of an axis, with the axis' range and its homing",
    options=(
        *MOTOR,
        POSITION_MIN,
        POSITION_MAX,
        ENDSTOP_PIN,
        POSITION_ENDSTOP,
        HOMING_SPEED,
        SECOND_HOMING_SPEED,
        RETRACT_DISTANCE,
        RETRACT_SPEED,
        POSITIVE_DIR,
    ),
    later=LATER_STEPPER_OPTIONS,
)
EXTRA_STEPPER = SectionSpec(
    help="A further stepper of an axis: stepper_z1, stepper_z2, …; its endstop waits for homing",
    options=(*MOTOR, ENDSTOP_PIN),
)

_EXTRA_STEPPER = re.compile(r"stepper_[xyz][1-9][0-9]?", re.ASCII)
# Read and checked, but their modules (motor enable, homing) are not built yet.
_WAITING = (
    ENABLE_PIN.name,
    ENDSTOP_PIN.name,
    HOMING_SPEED.name,
    SECOND_HOMING_SPEED.name,
    RETRACT_DISTANCE.name,
    RETRACT_SPEED.name,
    POSITIVE_DIR.name,
)

Weights = tuple[float, float, float, float]


def read_stepper(reader: SectionReader, weights: Weights, pins: PinRegistry) -> StepperDescription:
    """Return the stepper of a section; raises ConfigError."""
    step_pin = claim(reader, STEP_PIN, pins)
    dir_pin = claim(reader, DIR_PIN, pins)
    if dir_pin.node != step_pin.node:
        raise reader.bad(
            DIR_PIN,
            f"on node '{dir_pin.node}', but step_pin is on '{step_pin.node}'; both must be on one node",
        )
    microsteps = reader.get(MICROSTEPS)
    rotation_distance = reader.get(ROTATION_DISTANCE)
    full_steps = reader.get(FULL_STEPS)
    gear_ratio = reader.get(GEAR_RATIO)
    return StepperDescription(
        name=reader.name,
        step_pin=step_pin,
        dir_pin=dir_pin,
        enable_pin=claim(reader, ENABLE_PIN, pins) if reader.has(ENABLE_PIN) else None,
        weights=weights,
        step_distance=rotation_distance / (full_steps * microsteps * gear_ratio),
        rotation_distance=rotation_distance,
        full_steps_per_rotation=full_steps,
        microsteps=microsteps,
        gear_ratio=gear_ratio,
        step_pulse_s=reader.get(STEP_PULSE),
        place=reader.place,
    )


def claim(reader: SectionReader, option: PinOption, pins: PinRegistry) -> PinDescription:
    """Read a required pin and take it; raises ConfigError."""
    return pins.claim(reader.get(option), option, reader.section)


def read_rail(
    config: ConfigFile, axis: str, weights: Weights, pins: PinRegistry, later: list[NotYetActing]
) -> RailDescription:
    """Return an axis with all its steppers; raises ConfigError."""
    name = f"stepper_{axis}"
    section = config.sections.get(name)
    if section is None:
        raise ConfigError(
            Place(config.path, 0),
            f"there is no section [{name}]; add it: every axis needs its stepper",
        )
    reader = SectionReader(section, RAIL)
    first = read_stepper(reader, weights, pins)
    position_min, position_max = reader.get(POSITION_MIN), reader.get(POSITION_MAX)
    if position_max <= position_min:
        raise reader.bad(POSITION_MAX, f"must be above position_min ({position_min:g} mm)")
    homing = _read_homing(reader, position_min, position_max, pins)
    note_later(reader, later)
    further = []
    for extra in _extra_sections(config, name):
        extra_reader = SectionReader(extra, EXTRA_STEPPER)
        further.append(read_stepper(extra_reader, weights, pins))
        if extra_reader.has(ENDSTOP_PIN):
            _read_endstop(extra_reader, pins)
        note_later(extra_reader, later)
    return RailDescription(axis, (first, *further), position_min, position_max, homing, section.place)


def is_extra_stepper(name: str) -> bool:
    """Tell whether a section is a further stepper of an axis, such as stepper_z1."""
    return _EXTRA_STEPPER.fullmatch(name) is not None


def _extra_sections(config: ConfigFile, name: str) -> Iterator[RawSection]:
    """Yield the sections of further steppers by their number; raises ConfigError for a gap."""
    numbered = {
        int(other[len(name) :]): section
        for other, section in config.sections.items()
        if is_extra_stepper(other) and other.startswith(name)
    }
    for expected, number in enumerate(sorted(numbered), 1):
        if number != expected:
            raise ConfigError(
                numbered[number].place,
                f"[{name}{number}] without [{name}{expected}]: further steppers count from 1",
            )
        yield numbered[number]


def _read_endstop(reader: SectionReader, pins: PinRegistry) -> tuple[PinDescription | None, str]:
    """Return the endstop's pin, or the name of a virtual endstop that a later module offers."""
    pin = reader.find(ENDSTOP_PIN)
    if pin is None:
        return None, ""
    if pin.name.endswith("virtual_endstop") and pin.node not in pins.nodes:
        return None, f"{pin.node}:{pin.name}"
    return pins.claim(pin, ENDSTOP_PIN, reader.section), ""


def _read_homing(reader: SectionReader, low: float, high: float, pins: PinRegistry) -> HomingDescription:
    endstop_pin, virtual = _read_endstop(reader, pins)
    position = reader.find(POSITION_ENDSTOP)
    if position is not None and not low <= position <= high:
        raise reader.bad(
            POSITION_ENDSTOP, f"must be within position_min and position_max ({low:g} to {high:g} mm)"
        )
    if position is None and endstop_pin is not None:
        reader.get(POSITION_ENDSTOP)  # required: raises
    speed = reader.get(HOMING_SPEED)
    return HomingDescription(
        endstop_pin=endstop_pin,
        virtual_endstop=virtual,
        position_endstop=position,
        speed=speed,
        second_speed=reader.find(SECOND_HOMING_SPEED) or speed / 2,
        retract_distance=reader.get(RETRACT_DISTANCE),
        retract_speed=reader.find(RETRACT_SPEED) or speed,
        positive_dir=_homing_direction(reader, position, low, high),
    )


def _homing_direction(reader: SectionReader, position: float | None, low: float, high: float) -> bool:
    given = reader.find(POSITIVE_DIR)
    at_end = {True: low, False: high}
    if given is not None:
        if position == at_end[given]:
            raise reader.bad(
                POSITIVE_DIR, f"but position_endstop is {position:g} mm, the other end of the axis"
            )
        return given
    if position is None:
        return False
    # In the middle half a guess could drive the axis into its end.
    quarter = (high - low) / 4
    if low + quarter < position < high - quarter:
        raise reader.bad(
            POSITION_ENDSTOP, "at neither end of the axis; add homing_positive_dir to say where to home to"
        )
    return position >= high - quarter


def note_later(reader: SectionReader, later: list[NotYetActing]) -> None:
    """Finish a section and note which of its options wait for a module; raises ConfigError."""
    unread = {option.name for option in reader.finish()}
    waiting = tuple(name for name in reader.section.options if name in unread or name in _WAITING)
    if waiting:
        later.append(NotYetActing(reader.name, reader.place, waiting))
