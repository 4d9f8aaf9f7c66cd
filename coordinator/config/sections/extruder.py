"""[extruder], [extruder1], … and [extruder_stepper NAME]: steppers and limits of the filament."""

import math

from coordinator.config.errors import ConfigError
from coordinator.config.file import RawSection
from coordinator.config.model import ExtruderDescription, ExtruderStepperDescription
from coordinator.config.options import FloatOption, SectionReader, SectionSpec, TextOption
from coordinator.config.sections.bounds import MAX_SPEED, MIN_ACCEL, MIN_SPEED, accel_option, speed_option
from coordinator.config.sections.heater_options import EXTRUDER_HEATER_OPTIONS, UNSUPPORTED_HEATER_OPTIONS
from coordinator.config.sections.printer import PrinterSection
from coordinator.config.sections.reading import Reading
from coordinator.config.sections.steppers import MOTOR, read_stepper
from coordinator.config.unsupported import UNSUPPORTED_EXTRUDER_OPTIONS
from coordinator.kinematics.base import FILAMENT, StepFunction, WorkSpace
from coordinator.motion.specs import MotionLimits
from coordinator.motion.steps.steps import SMOOTH_MAX_S, SMOOTH_MIN_S
from coordinator.support.quoting import nearest_or_all

NOZZLE_DIAMETER = FloatOption(
    name="nozzle_diameter", help="bore of the nozzle", unit="mm", minimum=0.01, maximum=20
)
FILAMENT_DIAMETER = FloatOption(
    name="filament_diameter", help="diameter of the raw filament", unit="mm", minimum=0.1, maximum=20
)
MAX_CROSS_SECTION = FloatOption(
    name="max_extrude_cross_section",
    help="largest area of an extruded line, by default 4 nozzle_diameter²; moves above it are refused",
    unit="mm²",
    above=0,
    maximum=1e9,
)
MAX_ONLY_DISTANCE = FloatOption(
    name="max_extrude_only_distance",
    help="longest move of filament alone, and longest retraction",
    default=50.0,
    unit="mm",
    minimum=0,
    maximum=100_000,
)
MAX_ONLY_VELOCITY = speed_option(
    "max_extrude_only_velocity",
    "highest speed of filament alone, by default max_velocity · 4 nozzle_diameter² / filament area",
)
MAX_ONLY_ACCEL = accel_option(
    "max_extrude_only_accel",
    "highest acceleration of filament alone, by default max_accel · 4 nozzle_diameter² / filament area",
)
CORNER_VELOCITY = FloatOption(
    name="instantaneous_corner_velocity",
    help="how far the speed of the filament may jump between two moves",
    default=1.0,
    unit="mm/s",
    minimum=0,
    maximum=MAX_SPEED,
)
PRESSURE_ADVANCE = FloatOption(
    name="pressure_advance",
    help="how much further the filament is pushed while it moves: mm per mm/s",
    default=0.0,
    unit="s",
    minimum=0,
    maximum=10,
)
SMOOTH_TIME = FloatOption(
    name="pressure_advance_smooth_time",
    help="window over which pressure advance is spread",
    default=0.04,
    unit="s",
    minimum=SMOOTH_MIN_S,
    maximum=SMOOTH_MAX_S,
)
EXTRUDER = SectionSpec(
    help="An extruder's stepper and the limits of its filament; further ones are extruder1, extruder2, …",
    options=(
        *MOTOR,
        NOZZLE_DIAMETER,
        FILAMENT_DIAMETER,
        MAX_CROSS_SECTION,
        MAX_ONLY_DISTANCE,
        MAX_ONLY_VELOCITY,
        MAX_ONLY_ACCEL,
        CORNER_VELOCITY,
        PRESSURE_ADVANCE,
        SMOOTH_TIME,
    ),
    unsupported=UNSUPPORTED_EXTRUDER_OPTIONS + UNSUPPORTED_HEATER_OPTIONS,
    elsewhere=tuple(option.name for option in EXTRUDER_HEATER_OPTIONS),
)
FOLLOWED = TextOption(
    name="extruder",
    help="the extruder whose motion it follows, which then gives its pressure advance too; by default none",
    pattern=r"\S*",
    pattern_rule="the name of an extruder, or nothing",
)
EXTRUDER_STEPPER = SectionSpec(
    help="A further stepper that moves filament along with an extruder",
    options=(*MOTOR, FOLLOWED, PRESSURE_ADVANCE, SMOOTH_TIME),
)
MAX_EXTRUDERS = 16
MOVES = StepFunction(weights=FILAMENT)
STANDS = StepFunction()


def limits_without_extruder(printer: PrinterSection, space: WorkSpace) -> MotionLimits:
    """Return limits that refuse every move of filament."""
    return _limits(printer, space, ratio=0, only=(1, 1, 0), corner_velocity=0)


def read_extruders(
    reading: Reading, printer: PrinterSection, space: WorkSpace
) -> tuple[ExtruderDescription, ...]:
    """Return all extruders by number, the first of which is active; raises ConfigError."""
    extruders: list[ExtruderDescription] = []
    missing = ""
    for number in range(MAX_EXTRUDERS):
        name = f"extruder{number or ''}"
        section = reading.find(name)
        if section is None:
            missing = missing or name
        elif missing:
            raise ConfigError(
                section.place, f"[{name}] without [{missing}]: extruders count from [extruder] on"
            )
        else:
            extruders.append(_read_extruder(reading, section, printer, space, active=not extruders))
    return tuple(extruders)


def _read_extruder(
    reading: Reading, section: RawSection, printer: PrinterSection, space: WorkSpace, *, active: bool
) -> ExtruderDescription:
    reader = SectionReader(section, EXTRUDER)
    stepper = read_stepper(reader, MOVES if active else STANDS, reading.pins)
    nozzle, filament = reader.get(NOZZLE_DIAMETER), reader.get(FILAMENT_DIAMETER)
    if filament < nozzle:
        raise reader.bad(FILAMENT_DIAMETER, f"must be at least nozzle_diameter ({nozzle:g} mm)")
    filament_area = math.pi * (filament / 2) ** 2
    usual_cross_section = 4 * nozzle**2
    usual_ratio = usual_cross_section / filament_area
    limits = _limits(
        printer,
        space,
        ratio=reader.get_or(MAX_CROSS_SECTION, usual_cross_section) / filament_area,
        only=(
            reader.get_or(MAX_ONLY_VELOCITY, max(MIN_SPEED, printer.max_velocity * usual_ratio)),
            reader.get_or(MAX_ONLY_ACCEL, max(MIN_ACCEL, printer.max_accel * usual_ratio)),
            reader.get(MAX_ONLY_DISTANCE),
        ),
        corner_velocity=reader.get(CORNER_VELOCITY),
    )
    advance, smooth = reader.get(PRESSURE_ADVANCE), reader.get(SMOOTH_TIME)
    reading.finish(reader)
    return ExtruderDescription(section.name, stepper, nozzle, filament, advance, smooth, limits)


def read_extruder_steppers(
    reading: Reading, extruders: tuple[ExtruderDescription, ...]
) -> tuple[ExtruderStepperDescription, ...]:
    """Return the steppers that follow extruders; raises ConfigError."""
    return tuple(_read_follower(reading, s, extruders) for s in reading.named("extruder_stepper"))


def _read_follower(
    reading: Reading, section: RawSection, extruders: tuple[ExtruderDescription, ...]
) -> ExtruderStepperDescription:
    reader = SectionReader(section, EXTRUDER_STEPPER)
    name = reader.find(FOLLOWED) or ""
    followed = next((extruder for extruder in extruders if extruder.name == name), None)
    if name and followed is None:
        names = tuple(extruder.name for extruder in extruders)
        hint = nearest_or_all(name, names)
        raise reader.bad(FOLLOWED, f"but there is no such extruder{hint}")
    _check_advance(reader, followed)
    active = followed is not None and followed is extruders[0]
    function = MOVES if active else STANDS
    stepper = read_stepper(reader, function, reading.pins, name=section.instance)
    reading.finish(reader)
    return ExtruderStepperDescription(section.instance, stepper, name)


def _check_advance(reader: SectionReader, followed: ExtruderDescription | None) -> None:
    """Refuse values of its own: a stepper moves as its extruder's motion says, advance included."""
    own = (reader.find(PRESSURE_ADVANCE), reader.find(SMOOTH_TIME))
    if followed is None:
        return
    theirs = (followed.pressure_advance, followed.smooth_time_s)
    for option, mine, other in zip((PRESSURE_ADVANCE, SMOOTH_TIME), own, theirs, strict=True):
        if mine is not None and mine != other:
            raise reader.bad(
                option,
                f"but [{followed.name}], whose motion it follows, has {other:g}; one motion has one pressure"
                " advance: remove the option here",
            )


def _limits(
    printer: PrinterSection,
    space: WorkSpace,
    *,
    ratio: float,
    only: tuple[float, float, float],
    corner_velocity: float,
) -> MotionLimits:
    """Join all limits; only: speed, acceleration and length of a move of filament alone."""
    speeds, accels = printer.axis_velocity, printer.axis_accel
    return MotionLimits(
        max_velocity=printer.max_velocity,
        max_accel=printer.max_accel,
        max_x_velocity=speeds[0] or 0.0,
        max_y_velocity=speeds[1] or 0.0,
        max_z_velocity=speeds[2] or printer.max_velocity,
        max_x_accel=accels[0] or 0.0,
        max_y_accel=accels[1] or 0.0,
        max_z_accel=accels[2] or printer.max_accel,
        square_corner_velocity=printer.square_corner_velocity,
        minimum_cruise_ratio=printer.minimum_cruise_ratio,
        position_min=space.low,
        position_max=space.high,
        max_radius=space.max_radius,
        radius_min=space.radius_min,
        cone_slope=space.cone_slope,
        cone_top=space.cone_top,
        tower_radius=space.tower_radius,
        tower_rod=space.tower_rod,
        max_extrude_only_velocity=only[0],
        max_extrude_only_accel=only[1],
        max_extrude_only_distance=only[2],
        max_extrude_ratio=ratio,
        instantaneous_corner_velocity=corner_velocity,
    )
