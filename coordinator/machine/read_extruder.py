"""The section [extruder]: its stepper, and what filament may be asked of it."""

import math

from coordinator.machine.config_file import RawSection
from coordinator.machine.model import ExtruderDescription, NotYetActing, RailDescription
from coordinator.machine.options import FloatOption, SectionReader, SectionSpec
from coordinator.machine.pins import PinRegistry
from coordinator.machine.read_printer import MAX_ACCEL, MAX_SPEED, PrinterSection
from coordinator.machine.read_steppers import MOTOR, note_later, read_stepper
from coordinator.machine.well_known import LATER_EXTRUDER_OPTIONS
from coordinator.motion.specs import MotionLimits

NOZZLE_DIAMETER = FloatOption(
    name="nozzle_diameter", help="bore of the nozzle", unit="mm", above=0, maximum=20
)
FILAMENT_DIAMETER = FloatOption(
    name="filament_diameter", help="diameter of the raw filament", unit="mm", above=0, maximum=20
)
MAX_CROSS_SECTION = FloatOption(
    name="max_extrude_cross_section",
    help="largest area of an extruded line, by default 4 nozzle_diameter²; moves above it are refused",
    unit="mm²",
    above=0,
    maximum=10_000,
)
MAX_ONLY_DISTANCE = FloatOption(
    name="max_extrude_only_distance",
    help="longest move of filament alone",
    default=50.0,
    unit="mm",
    minimum=0,
    maximum=100_000,
)
MAX_ONLY_VELOCITY = FloatOption(
    name="max_extrude_only_velocity",
    help="highest speed of filament alone, by default max_velocity · 4 nozzle_diameter² / filament area",
    unit="mm/s",
    above=0,
    maximum=MAX_SPEED,
)
MAX_ONLY_ACCEL = FloatOption(
    name="max_extrude_only_accel",
    help="highest acceleration of filament alone, by default max_accel · 4 nozzle_diameter² / filament area",
    unit="mm/s²",
    above=0,
    maximum=MAX_ACCEL,
)
CORNER_VELOCITY = FloatOption(
    name="instantaneous_corner_velocity",
    help="how far the speed of the filament may jump between two moves",
    default=1.0,
    unit="mm/s",
    minimum=0,
    maximum=MAX_SPEED,
)
EXTRUDER = SectionSpec(
    help="The extruder's stepper and the limits of the filament",
    options=(
        *MOTOR,
        NOZZLE_DIAMETER,
        FILAMENT_DIAMETER,
        MAX_CROSS_SECTION,
        MAX_ONLY_DISTANCE,
        MAX_ONLY_VELOCITY,
        MAX_ONLY_ACCEL,
        CORNER_VELOCITY,
    ),
    later=LATER_EXTRUDER_OPTIONS,
)

Rails = tuple[RailDescription, RailDescription, RailDescription]


def limits_without_extruder(printer: PrinterSection, rails: Rails) -> MotionLimits:
    """Return limits that refuse every move of filament."""
    return _limits(printer, rails, ratio=0, only=(1, 1, 0), corner_velocity=0)


def read_extruder(
    section: RawSection, printer: PrinterSection, rails: Rails, pins: PinRegistry, later: list[NotYetActing]
) -> tuple[ExtruderDescription, MotionLimits]:
    """Return the extruder and the machine's limits with it; raises ConfigError."""
    reader = SectionReader(section, EXTRUDER)
    stepper = read_stepper(reader, (0, 0, 0, 1), pins)
    nozzle, filament = reader.get(NOZZLE_DIAMETER), reader.get(FILAMENT_DIAMETER)
    if filament < nozzle:
        raise reader.bad(FILAMENT_DIAMETER, f"must be at least nozzle_diameter ({nozzle:g} mm)")
    filament_area = math.pi * (filament / 2) ** 2
    usual_cross_section = 4 * nozzle**2
    usual_ratio = usual_cross_section / filament_area
    limits = _limits(
        printer,
        rails,
        ratio=(reader.find(MAX_CROSS_SECTION) or usual_cross_section) / filament_area,
        only=(
            reader.find(MAX_ONLY_VELOCITY) or printer.max_velocity * usual_ratio,
            reader.find(MAX_ONLY_ACCEL) or printer.max_accel * usual_ratio,
            reader.get(MAX_ONLY_DISTANCE),
        ),
        corner_velocity=reader.get(CORNER_VELOCITY),
    )
    note_later(reader, later)
    return ExtruderDescription(stepper, nozzle, filament), limits


def _limits(
    printer: PrinterSection,
    rails: Rails,
    *,
    ratio: float,
    only: tuple[float, float, float],
    corner_velocity: float,
) -> MotionLimits:
    """Join all limits; only: speed, acceleration and length of a move of filament alone."""
    x, y, z = rails
    return MotionLimits(
        max_velocity=printer.max_velocity,
        max_accel=printer.max_accel,
        max_z_velocity=printer.max_z_velocity,
        max_z_accel=printer.max_z_accel,
        square_corner_velocity=printer.square_corner_velocity,
        minimum_cruise_ratio=printer.minimum_cruise_ratio,
        position_min=(x.position_min, y.position_min, z.position_min),
        position_max=(x.position_max, y.position_max, z.position_max),
        max_extrude_only_velocity=only[0],
        max_extrude_only_accel=only[1],
        max_extrude_only_distance=only[2],
        max_extrude_ratio=ratio,
        instantaneous_corner_velocity=corner_velocity,
    )
