"""What describes a kinematics to the configuration, and what its reader returns."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

from coordinator.config.errors import ConfigError
from coordinator.config.model import DualCarriageDescription, RailDescription, StepperDescription
from coordinator.config.options import SectionReader, SectionSpec
from coordinator.config.sections.reading import Reading
from coordinator.kinematics.base import Kinematics, Point, WorkSpace
from coordinator.motion.specs import AXIS_RANGE_OPTIONS


@dataclass(frozen=True, slots=True)
class Frame:
    """All that moves the head."""

    kinematics: Kinematics
    rails: tuple[RailDescription, ...]
    home: Point
    """Where the head is after homing."""
    motors: tuple[StepperDescription, ...] = ()
    """Empty: the steppers of the rails, in order."""
    dual_carriage: DualCarriageDescription | None = None
    range_options: tuple[str, str, str] = AXIS_RANGE_OPTIONS
    """Which options say how far X, Y and Z may go."""

    @property
    def steppers(self) -> tuple[StepperDescription, ...]:
        """All steppers, each once."""
        return self.motors or tuple(stepper for rail in self.rails for stepper in rail.steppers)


@dataclass(frozen=True, slots=True)
class KinematicsKind:
    """One value of ``kinematics`` in [printer]."""

    kinematics: type[Kinematics]
    read: Callable[[Reading, SectionReader], Frame]
    """Reads the sections and its options in [printer]; raises ConfigError."""
    printer: SectionSpec | None = None
    """Its options in [printer]."""
    steppers: tuple[str, ...] = ()
    """Sections [stepper_NAME] that it has, but for those of one letter."""
    reference: Mapping[str, SectionSpec] = field(default_factory=dict)
    """Its own sections for docs/configuration.md, by title."""


def axis_range(rail: RailDescription) -> tuple[float, float]:
    """Return how far a rail with position_min and position_max goes."""
    assert rail.position_min is not None
    assert rail.position_max is not None
    return rail.position_min, rail.position_max


def box_of(x: RailDescription, y: RailDescription, z: RailDescription) -> WorkSpace:
    """Return the box that three axes span."""
    ranges = [axis_range(rail) for rail in (x, y, z)]
    return WorkSpace((ranges[0][0], ranges[1][0], ranges[2][0]), (ranges[0][1], ranges[1][1], ranges[2][1]))


def tidy(point: Point) -> Point:
    """Return a point that was calculated without its rounding errors: to the picometre."""
    x, y, z = (round(value, 9) + 0.0 for value in point)
    return (x, y, z)


def home_at_endstops(machine: Kinematics, positions: tuple[float, ...], first: SectionReader) -> Point:
    """Return where the head is with the towers or arms at POSITIONS, their endstops.

    Raises ConfigError, at the section of the FIRST one, when the rods do not meet there.
    """
    try:
        return tidy(machine.forward(positions))
    except (ValueError, ZeroDivisionError):
        sentence = (
            f"the rods of [{first.name}] and the others do not meet when all are at their endstops; correct"
            " position_endstop, or the lengths"
        )
        raise ConfigError(first.place, sentence) from None


def home_of(rail: RailDescription) -> float:
    """Return where an axis is after homing, mm."""
    return rail.homing.position_endstop or 0.0
