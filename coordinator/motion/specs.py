"""What motion needs to know about the machine: plain values, checked by their builder."""

from dataclasses import dataclass

AXIS_RANGE_OPTIONS = (
    "position_min and position_max of [stepper_x]",
    "position_min and position_max of [stepper_y]",
    "position_min and position_max of [stepper_z]",
)
"""Where each axis has its rail."""


@dataclass(frozen=True, slots=True)
class MotionLimits:
    """What every move must respect. Lengths in mm, times in s; vectors are X Y Z."""

    max_velocity: float
    """mm/s along the path."""
    max_accel: float
    """mm/s² along the path."""
    max_z_velocity: float
    max_z_accel: float
    square_corner_velocity: float
    """mm/s at which a right-angled corner may be taken."""
    minimum_cruise_ratio: float
    """0 <= ratio < 1: the share of a short move that shall be cruise, which limits zig-zag."""
    position_min: tuple[float, float, float]
    position_max: tuple[float, float, float]
    max_extrude_only_velocity: float
    """mm/s of filament, for moves of E alone."""
    max_extrude_only_accel: float
    max_extrude_only_distance: float
    """mm of filament in one move of E alone."""
    max_extrude_ratio: float
    """mm of filament per mm of path above which a printing move is refused (cross section over area)."""
    instantaneous_corner_velocity: float
    """mm/s by which the filament's speed may jump at a junction."""
    max_x_velocity: float = 0.0
    """mm/s along X; 0 here and below: no limit of its own."""
    max_x_accel: float = 0.0
    max_y_velocity: float = 0.0
    max_y_accel: float = 0.0
    max_radius: float = 0.0
    """Largest distance of the head from the Z axis: a round work space within the box."""
    radius_min: float = 0.0
    """Smallest distance of the head from the Z axis, on all of its way."""
    cone_slope: tuple[float, float] = (0.0, 0.0)
    """Slopes 0: no cone. Else Z may be above position_max (as after homing a delta) within the cone
    z + √((sx·x)² + (sy·y)²) <= cone_top, and moves that begin or end above stay within."""
    cone_top: float = 0.0
    tower_radius: float = 0.0
    """mm; of a delta: how far level its rods reach with the head in the middle."""
    tower_rod: float = 0.0
    """mm; of a delta: length of its shortest rod. Where it lies so flat that its carriage would be more than
    three times as fast as the head, the head is slower. 0: no delta."""
    range_options: tuple[str, str, str] = AXIS_RANGE_OPTIONS
    """For messages: which options of the configuration say how far X, Y and Z may go."""


@dataclass(frozen=True, slots=True)
class NodeStreamSpec:
    """How one node takes step commands. Ids come from its dictionary."""

    name: str
    clock_freq: int
    """Nominal ticks per second."""
    move_count: int
    """Queue slots shared by all timed commands of the node."""
    queue_step_id: int
    set_next_step_dir_id: int
    reset_step_clock_id: int


@dataclass(frozen=True, slots=True)
class StepperSpec:
    """One stepper."""

    name: str
    node: int
    """Index into the list of NodeStreamSpec."""
    oid: int
    weights: tuple[float, float, float, float]
    """Of a stepper without a formula: its position in mm is the sum of weights[i] * axis[i] over X Y Z E."""
    step_distance: float
    """mm (of an angle: rad) per step, > 0."""
    invert_dir: bool
    """Whether set_next_step_dir takes 0 for a positive step."""
    step_pulse_s: float
    """Shortest high time of the step pin; steps are never closer than two of them. 0: both edges step."""
    formula: str | None = None
    """Name of the C function (coordinator/kinematics/*.c) that gives its position; None: WEIGHTS do."""
    params: tuple[float, ...] = ()
    """Of the formula."""
