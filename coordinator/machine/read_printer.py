"""The section [printer], and how it and [extruder] limit every move."""

from coordinator.machine.config_file import RawSection
from coordinator.machine.model import NotYetActing
from coordinator.machine.options import ChoiceOption, FloatOption, SectionReader, SectionSpec
from coordinator.machine.well_known import LATER_PRINTER_OPTIONS
from nodes.records import record

# Far above any machine, low enough that squares and sums stay exact and a slipped digit group is seen.
MAX_SPEED = 100_000.0
MAX_ACCEL = 10_000_000.0

KINEMATICS = ChoiceOption(
    name="kinematics",
    help="how the steppers move the head",
    choices=("cartesian", "corexy"),
    later=(
        "corexz",
        "delta",
        "deltesian",
        "generic_cartesian",
        "hybrid_corexy",
        "hybrid_corexz",
        "none",
        "polar",
        "rotary_delta",
        "winch",
    ),
)
MAX_VELOCITY = FloatOption(
    name="max_velocity", help="highest speed of the head", unit="mm/s", above=0, maximum=MAX_SPEED
)
MAX_ACCEL_OPTION = FloatOption(
    name="max_accel", help="highest acceleration of the head", unit="mm/s²", above=0, maximum=MAX_ACCEL
)
MAX_Z_VELOCITY = FloatOption(
    name="max_z_velocity",
    help="highest speed along Z; by default max_velocity",
    unit="mm/s",
    above=0,
    maximum=MAX_SPEED,
)
MAX_Z_ACCEL = FloatOption(
    name="max_z_accel",
    help="highest acceleration along Z; by default max_accel",
    unit="mm/s²",
    above=0,
    maximum=MAX_ACCEL,
)
SQUARE_CORNER_VELOCITY = FloatOption(
    name="square_corner_velocity",
    help="speed at which a right-angled corner may be taken",
    default=5.0,
    unit="mm/s",
    minimum=0,
    maximum=MAX_SPEED,
)
MINIMUM_CRUISE_RATIO = FloatOption(
    name="minimum_cruise_ratio",
    help="share of a short move that is to be cruise, which limits zig-zag",
    default=0.5,
    minimum=0,
    below=1,
)
MAX_ACCEL_TO_DECEL = FloatOption(
    name="max_accel_to_decel",
    help="older form of minimum_cruise_ratio, which becomes 1 - max_accel_to_decel / max_accel",
    unit="mm/s²",
    above=0,
    maximum=MAX_ACCEL,
)
PRINTER = SectionSpec(
    help="The machine as a whole",
    options=(
        KINEMATICS,
        MAX_VELOCITY,
        MAX_ACCEL_OPTION,
        MAX_Z_VELOCITY,
        MAX_Z_ACCEL,
        SQUARE_CORNER_VELOCITY,
        MINIMUM_CRUISE_RATIO,
        MAX_ACCEL_TO_DECEL,
    ),
    later=LATER_PRINTER_OPTIONS,
)


@record
class PrinterSection:
    """[printer] as read; units as in MotionLimits."""

    kinematics: str
    max_velocity: float
    max_accel: float
    max_z_velocity: float
    max_z_accel: float
    square_corner_velocity: float
    minimum_cruise_ratio: float


def read_printer(section: RawSection, later: list[NotYetActing]) -> PrinterSection:
    """Return the limits of the whole machine; raises ConfigError."""
    reader = SectionReader(section, PRINTER)
    max_velocity = reader.get(MAX_VELOCITY)
    max_accel = reader.get(MAX_ACCEL_OPTION)
    printer = PrinterSection(
        kinematics=reader.get(KINEMATICS),
        max_velocity=max_velocity,
        max_accel=max_accel,
        max_z_velocity=reader.find(MAX_Z_VELOCITY) or max_velocity,
        max_z_accel=reader.find(MAX_Z_ACCEL) or max_accel,
        square_corner_velocity=reader.get(SQUARE_CORNER_VELOCITY),
        minimum_cruise_ratio=_cruise_ratio(reader, max_accel),
    )
    if waiting := reader.finish():
        later.append(NotYetActing(section.name, section.place, tuple(option.name for option in waiting)))
    return printer


def _cruise_ratio(reader: SectionReader, max_accel: float) -> float:
    if reader.has(MINIMUM_CRUISE_RATIO):
        return reader.get(
            MINIMUM_CRUISE_RATIO
        )  # then an older max_accel_to_decel beside it has no effect: finish tells
    max_accel_to_decel = reader.find(MAX_ACCEL_TO_DECEL)
    if max_accel_to_decel is None:
        return reader.get(MINIMUM_CRUISE_RATIO)
    return 1 - min(1.0, max_accel_to_decel / max_accel)
