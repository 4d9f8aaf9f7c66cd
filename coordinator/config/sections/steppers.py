"""Motors: what every stepper's section has in common."""

import math
import re
from collections.abc import Iterator

from coordinator.config.errors import ConfigError, NotSupported
from coordinator.config.file import RawSection
from coordinator.config.model import StepperDescription
from coordinator.config.options import FloatOption, GearRatioOption, IntOption, SectionReader
from coordinator.config.pins import PinDescription, PinOption, PinRegistry
from coordinator.config.sections.reading import Reading
from coordinator.kinematics.base import StepFunction

STEP_PIN = PinOption(name="step_pin", help="the driver's step input")
DIR_PIN = PinOption(name="dir_pin", help="the driver's direction input; ! when high means negative")
ENABLE_PIN = PinOption(name="enable_pin", help="the driver's enable input; may be shared", share="enable")
MICROSTEPS = IntOption(name="microsteps", help="microsteps the driver is set to", minimum=1, maximum=256)
ROTATION_DISTANCE = FloatOption(
    name="rotation_distance",
    help="way of the axis for one turn of the motor, or of the last gear",
    unit="mm",
    minimum=0.001,
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
TURNING_GEAR_RATIO = GearRatioOption(
    name="gear_ratio", help="gears between motor and what it turns; 1:1 for none"
)
TURNING_MOTOR = (STEP_PIN, DIR_PIN, ENABLE_PIN, MICROSTEPS, FULL_STEPS, TURNING_GEAR_RATIO, STEP_PULSE)
"""Of a motor that turns the bed or an arm instead of moving a rail."""

MIN_STEP = 3e-7
"""mm, or rad: all of a machine's range is then below the 1e12 steps that step generation counts to."""

_EXTRA_STEPPER = re.compile(r"stepper_[a-z]+[1-9][0-9]?|dual_carriage[1-9][0-9]?", re.ASCII)


def read_stepper(
    reader: SectionReader, function: StepFunction, pins: PinRegistry, *, name: str = ""
) -> StepperDescription:
    """Return the stepper of a section, by the section's name if no NAME is given; raises ConfigError."""
    step_pin = claim(reader, STEP_PIN, pins)
    dir_pin = claim(reader, DIR_PIN, pins)
    if dir_pin.node != step_pin.node:
        raise reader.bad(
            DIR_PIN,
            f"on node '{dir_pin.node}', but step_pin is on '{step_pin.node}'; both must be on one node",
        )
    microsteps = reader.get(MICROSTEPS)
    rotation_distance = math.tau if function.turns else reader.get(ROTATION_DISTANCE)
    full_steps = reader.get(FULL_STEPS)
    gear_ratio = reader.get(TURNING_GEAR_RATIO if function.turns else GEAR_RATIO)
    step_distance = rotation_distance / (full_steps * microsteps * gear_ratio)
    if step_distance < MIN_STEP:
        unit = "rad" if function.turns else "mm"
        raise ConfigError(
            reader.place,
            f"a step of [{reader.name}] is {step_distance:g} {unit}, must be at least {MIN_STEP:g} {unit};"
            " correct its gear_ratio, microsteps and the like",
        )
    enable_pin, unpowered = _claim_enable(reader, pins)
    return StepperDescription(
        name=name or reader.name,
        step_pin=step_pin,
        dir_pin=dir_pin,
        enable_pin=enable_pin,
        function=function,
        step_distance=step_distance,
        rotation_distance=rotation_distance,
        full_steps_per_rotation=full_steps,
        microsteps=microsteps,
        gear_ratio=gear_ratio,
        step_pulse_s=reader.get(STEP_PULSE),
        place=reader.place,
        unpowered=unpowered,
    )


def _claim_enable(reader: SectionReader, pins: PinRegistry) -> tuple[PinDescription | None, str]:
    """Return the enable pin, if there is one, and why it cannot be switched, if so; raises ConfigError."""
    if not reader.has(ENABLE_PIN):
        return None, ""
    try:
        return claim(reader, ENABLE_PIN, pins), ""
    except NotSupported as error:
        return None, error.reason


def claim(reader: SectionReader, option: PinOption, pins: PinRegistry) -> PinDescription:
    """Read a required pin and take it; raises ConfigError."""
    return pins.claim(reader.get(option), option, reader.section)


def is_extra_stepper(name: str) -> bool:
    """Return whether a section is a further stepper of a rail, such as stepper_z1."""
    return _EXTRA_STEPPER.fullmatch(name) is not None


def extra_sections(reading: Reading, name: str) -> Iterator[RawSection]:
    """Yield the sections of further steppers by their number; raises ConfigError for a gap."""
    numbered = {
        int(other[len(name) :]): section
        for other, section in reading.config.sections.items()
        if is_extra_stepper(other) and other.rstrip("0123456789") == name
    }
    for expected, number in enumerate(sorted(numbered), 1):
        if number != expected:
            raise ConfigError(
                numbered[number].place,
                f"[{name}{number}] without [{name}{expected}]: further steppers count from 1",
            )
        reading.used.add(numbered[number].name)
        yield numbered[number]
