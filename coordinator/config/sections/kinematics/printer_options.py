"""What [printer] may contain besides for some kinematics; apart from their readers, not all of which load."""

from collections.abc import Mapping

from coordinator.config.options import FloatOption, SectionSpec
from coordinator.config.sections.steppers import MAX_POSITION

MINIMUM_Z = FloatOption(
    name="minimum_z_position",
    help="lowest Z that the head may go to",
    default=0.0,
    unit="mm",
    minimum=-MAX_POSITION,
    maximum=MAX_POSITION,
)
DELTA_RADIUS = FloatOption(
    name="delta_radius",
    help="from a tower's joint to the head's, measured level, with the head in the middle",
    unit="mm",
    above=0,
    maximum=MAX_POSITION,
)
PRINT_RADIUS = FloatOption(
    name="print_radius",
    help="how far from the middle the head may be; by default delta_radius, or less where rods lie too flat",
    unit="mm",
    above=0,
    maximum=MAX_POSITION,
)
ROUND_RANGE_OPTIONS = (
    "print_radius of [printer]",
    "print_radius of [printer]",
    "minimum_z_position of [printer] and position_endstop of [stepper_a]",
)
"""What says how far X, Y and Z may go where carriages or arms stand around the bed."""
DELTA_PRINTER = SectionSpec(
    help="What a delta needs besides", options=(DELTA_RADIUS, PRINT_RADIUS, MINIMUM_Z)
)
MIN_ANGLE = FloatOption(
    name="min_angle",
    help="smallest angle between a rod and the horizontal, which limits X",
    default=5.0,
    unit="°",
    above=0,
    below=90,
)
PRINT_WIDTH = FloatOption(
    name="print_width",
    help="range of X, centred; by default what min_angle allows",
    unit="mm",
    above=0,
    maximum=MAX_POSITION,
)
DELTESIAN_PRINTER = SectionSpec(
    help="What a deltesian needs besides",
    options=(MINIMUM_Z, MIN_ANGLE, PRINT_WIDTH),
    later=("slow_ratio",),
)
SHOULDER_RADIUS = FloatOption(
    name="shoulder_radius",
    help="radius of the shoulders' circle less that of the joints at the head",
    unit="mm",
    above=0,
    maximum=MAX_POSITION,
)
SHOULDER_HEIGHT = FloatOption(
    name="shoulder_height",
    help="height of the shoulders above the bed less that of the head's joints above the nozzle",
    unit="mm",
    above=0,
    maximum=MAX_POSITION,
)
ARMS_PRINT_RADIUS = FloatOption(
    name="print_radius",
    help="how far from the middle the head may be; by default what gives the largest cylinder",
    unit="mm",
    above=0,
    maximum=MAX_POSITION,
)
ROTARY_DELTA_PRINTER = SectionSpec(
    help="What a rotary delta needs besides",
    options=(SHOULDER_RADIUS, SHOULDER_HEIGHT, ARMS_PRINT_RADIUS, MINIMUM_Z),
)
POLAR_PRINTER = SectionSpec(
    help="What a polar machine may have besides", options=(), later=("max_angular_velocity",)
)
PRINTER_SPECS: Mapping[str, SectionSpec] = {
    "delta": DELTA_PRINTER,
    "deltesian": DELTESIAN_PRINTER,
    "polar": POLAR_PRINTER,
    "rotary_delta": ROTARY_DELTA_PRINTER,
}
"""By kinematics."""
