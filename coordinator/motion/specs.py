"""What motion is told about the machine: plain values, checked by whoever builds them."""

from dataclasses import dataclass
from enum import IntEnum


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


class StepKinematics(IntEnum):
    """What a stepper's position is as a function of the axes; the numbers are those of steps.h."""

    LINEAR = 0
    """Sum of weights times axes."""
    DELTA = 1
    """Height of a carriage; params: arm², tower x, tower y."""
    DELTESIAN = 2
    """Height of a carriage; params: arm², arm x."""
    POLAR_RADIUS = 3
    """Distance from the Z axis."""
    POLAR_ANGLE = 4
    """Angle around the Z axis, unwrapped, rad."""
    ROTARY_DELTA = 5
    """Angle of an upper arm, rad; params: see kinematics/rotary_delta.py."""
    WINCH = 6
    """Distance from the anchor; params: x, y, z."""


@dataclass(frozen=True, slots=True)
class StepperSpec:
    """One stepper."""

    name: str
    node: int
    """Index into the list of NodeStreamSpec."""
    oid: int
    weights: tuple[float, float, float, float]
    """Of a LINEAR stepper: its position in mm is the sum of weights[i] * axis[i] over X Y Z E."""
    step_distance: float
    """mm (POLAR_ANGLE and ROTARY_DELTA: rad) per step, > 0."""
    invert_dir: bool
    """Whether set_next_step_dir takes 0 for a positive step."""
    step_pulse_s: float
    """Shortest high time of the step pin; steps are never closer than two of them. 0: both edges step."""
    kinematics: StepKinematics = StepKinematics.LINEAR
    params: tuple[float, ...] = ()
    """Of the kinematics."""
