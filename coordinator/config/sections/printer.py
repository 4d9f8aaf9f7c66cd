"""The section [printer], and how it and [extruder] limit every move."""

from dataclasses import dataclass

from coordinator.config.errors import ConfigError
from coordinator.config.file import RawSection
from coordinator.config.options import ChoiceOption, FloatOption, SectionReader, SectionSpec, one_of
from coordinator.config.sections.bounds import MAX_SPEED, accel_option, speed_option
from coordinator.config.sections.kinematics.registry import KINDS, PRINTER_SPECS

KINEMATICS = ChoiceOption(
    name="kinematics",
    help="how the steppers move the head",
    choices=tuple(KINDS),
)
MAX_VELOCITY = speed_option("max_velocity", "highest speed of the head")
MAX_ACCEL_OPTION = accel_option("max_accel", "highest acceleration of the head")


def _axis_velocity(axis: str) -> FloatOption:
    return speed_option(
        f"max_{axis}_velocity", f"highest speed along {axis.upper()}; by default max_velocity"
    )


def _axis_accel(axis: str) -> FloatOption:
    return accel_option(
        f"max_{axis}_accel", f"highest acceleration along {axis.upper()}; by default max_accel"
    )


AXIS_VELOCITIES = tuple(_axis_velocity(axis) for axis in "xyz")
AXIS_ACCELS = tuple(_axis_accel(axis) for axis in "xyz")
SQUARE_CORNER_VELOCITY = FloatOption(
    name="square_corner_velocity",
    help="speed at which a right-angled corner may be taken",
    default=5.0,
    unit="mm/s",
    minimum=0,
    maximum=MAX_SPEED,
)
MAX_CRUISE_RATIO = 0.999
"""The planner takes no more (motion/planner/values.py)."""
MINIMUM_CRUISE_RATIO = FloatOption(
    name="minimum_cruise_ratio",
    help="smallest share of a short move that is cruise, which limits zig-zag",
    default=0.5,
    minimum=0,
    maximum=MAX_CRUISE_RATIO,
)
MAX_ACCEL_TO_DECEL = accel_option(
    "max_accel_to_decel",
    "older form of minimum_cruise_ratio, which becomes 1 - max_accel_to_decel / max_accel",
)
PRINTER = SectionSpec(
    help="The machine as a whole, whatever its kinematics",
    options=(
        KINEMATICS,
        MAX_VELOCITY,
        MAX_ACCEL_OPTION,
        *AXIS_VELOCITIES,
        *AXIS_ACCELS,
        SQUARE_CORNER_VELOCITY,
        MINIMUM_CRUISE_RATIO,
        MAX_ACCEL_TO_DECEL,
    ),
    unsupported=("invert_kinematics", "scale_xy_accel"),
)


@dataclass(frozen=True, slots=True)
class PrinterSection:
    """[printer] as read; units as in MotionLimits."""

    max_velocity: float
    max_accel: float
    axis_velocity: tuple[float | None, ...]
    """Of X, Y and Z; None: no limit of its own."""
    axis_accel: tuple[float | None, ...]
    square_corner_velocity: float
    minimum_cruise_ratio: float


def open_printer(section: RawSection) -> tuple[str, SectionReader]:
    """Return the kinematics, and a reader of [printer] with its options; raises ConfigError."""
    names = {
        k: (*spec.unsupported, *(option.name for option in spec.options)) for k, spec in PRINTER_SPECS.items()
    }
    every = tuple({name: None for owned in (PRINTER.unsupported, *names.values()) for name in owned})
    kinematics = SectionReader(section, SectionSpec(PRINTER.help, PRINTER.options, every)).get(KINEMATICS)
    for name, option in section.options.items():
        owners = [owner for owner, owned in names.items() if name in owned]
        if owners and kinematics not in owners:
            raise ConfigError(
                option.place,
                f"option '{name}' of [{section.name}] belongs to kinematics {one_of(owners)}, but this"
                f" machine is {kinematics}; remove it",
            )
    own = PRINTER_SPECS.get(kinematics, SectionSpec("", ()))
    unsupported = (*PRINTER.unsupported, *own.unsupported)
    spec = SectionSpec(PRINTER.help, (*PRINTER.options, *own.options), unsupported)
    reader = SectionReader(section, spec)
    reader.get(KINEMATICS)
    return kinematics, reader


def read_printer(reader: SectionReader) -> PrinterSection:
    """Return the limits of the whole machine; raises ConfigError."""
    max_velocity, max_accel = reader.get(MAX_VELOCITY), reader.get(MAX_ACCEL_OPTION)
    reader.show_default(AXIS_VELOCITIES[2], max_velocity)
    reader.show_default(AXIS_ACCELS[2], max_accel)
    return PrinterSection(
        max_velocity=max_velocity,
        max_accel=max_accel,
        axis_velocity=tuple(reader.find(option) for option in AXIS_VELOCITIES),
        axis_accel=tuple(reader.find(option) for option in AXIS_ACCELS),
        square_corner_velocity=reader.get(SQUARE_CORNER_VELOCITY),
        minimum_cruise_ratio=_cruise_ratio(reader, max_accel),
    )


def _cruise_ratio(reader: SectionReader, max_accel: float) -> float:
    if reader.has(MINIMUM_CRUISE_RATIO):
        return reader.get(
            MINIMUM_CRUISE_RATIO
        )  # then an older max_accel_to_decel has no effect: finish reports it
    max_accel_to_decel = reader.find(MAX_ACCEL_TO_DECEL)
    if max_accel_to_decel is None:
        return reader.get(MINIMUM_CRUISE_RATIO)
    return min(MAX_CRUISE_RATIO, 1 - min(1.0, max_accel_to_decel / max_accel))
