"""What the planner takes and gives: feed results, refusals, trapezoids."""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields
from enum import IntEnum
from typing import Any, Final, NamedTuple

from coordinator.motion.planner._planner import lib
from coordinator.motion.specs import MotionLimits

Position = tuple[float, float, float, float]


class FeedStatus(IntEnum):
    """Why ``feed`` stopped."""

    NEED_DATA = lib.GCODE_NEED_DATA
    """No whole line is left."""
    OTHER_LINE = lib.GCODE_OTHER_LINE
    """The line at the offset is not the planner's: act on it, call ``line_done`` and feed on behind it."""
    FULL = lib.GCODE_FULL
    """The ring is full or reaches beyond ``plan_until``: take trapezoids, then feed on."""
    LIMIT = lib.GCODE_LIMIT
    """The move of the line at the offset is refused: see ``Planner.fault``."""


class Feed(NamedTuple):
    """Where ``feed`` stopped."""

    status: FeedStatus
    offset: int
    """Behind the last byte consumed."""
    line: int
    """Number of the line at the offset, the first being 1."""


class PlannerState(NamedTuple):
    """Where the moves read so far lead to, and what holds for those to come; mm, mm/s, mm/s², s."""

    toolhead_position: Position
    """In the machine's frame."""
    gcode_position: Position
    """The same in the frame and the units of the program."""
    gcode_base: Position
    """The program's origin in the machine's frame."""
    gcode_offset: Position
    """SET_GCODE_OFFSET."""
    homed: str
    """Letters of the homed axes."""
    speed_mm_s: float
    speed_factor: float
    extrude_factor: float
    unit_mm: float
    relative: bool
    relative_extrusion: bool
    max_velocity: float
    accel: float
    minimum_cruise_ratio: float
    square_corner_velocity: float
    print_time_end_s: float
    limits: MotionLimits
    """What is configured."""


class FaultKind(IntEnum):
    """Why a move was refused."""

    NOT_HOMED = lib.PLANNER_NOT_HOMED
    OUTSIDE = lib.PLANNER_OUTSIDE
    EXTRUDE_LONG = lib.PLANNER_EXTRUDE_LONG
    EXTRUDE_RATIO = lib.PLANNER_EXTRUDE_RATIO
    SPEED = lib.PLANNER_SPEED
    TOO_FAR = lib.PLANNER_TOO_FAR
    TOO_NEAR = lib.PLANNER_TOO_NEAR
    COLD = lib.PLANNER_COLD


@dataclass(frozen=True, slots=True)
class Fault:
    """A move the machine must not make."""

    kind: FaultKind
    axis: str
    value: float
    low: float
    high: float
    options: str = ""
    """Those of the configuration that bound the axis."""

    def __str__(self) -> str:
        """Say what is wrong and what to do, without the place."""
        if self.kind in (FaultKind.EXTRUDE_LONG, FaultKind.EXTRUDE_RATIO) and not self.high:
            return "the move pushes filament, but this machine has no extruder; leave E out"
        return _FAULTS[self.kind](self)


_FAULTS: Mapping[FaultKind, Callable[[Fault], str]] = {
    FaultKind.NOT_HOMED: lambda f: f"{f.axis} is to move before it is homed; home with G28 first",
    FaultKind.OUTSIDE: lambda f: (
        f"the move goes to {f.axis} {f.value:.6g} mm, outside {f.low:.6g} to {f.high:.6g} mm; "
        f"correct the program or {f.options}"
    ),
    FaultKind.EXTRUDE_LONG: lambda f: (
        f"the move pushes {f.value:.6g} mm of filament at once, more than {f.high:.6g} mm; "
        "check M82/M83 and G92 E, or raise max_extrude_only_distance of [extruder]"
    ),
    FaultKind.EXTRUDE_RATIO: lambda f: (
        f"the move pushes {f.value:.4g} mm of filament per mm of path, more than {f.high:.4g}; "
        "check M82/M83 and G92 E, or raise max_extrude_cross_section of [extruder]"
    ),
    FaultKind.COLD: lambda f: (
        f"the move is to move {f.value:.6g} mm of filament, but the extruder is colder than its"
        " min_extrude_temp; heat it first with M109, or correct that option of [extruder]"
    ),
    FaultKind.SPEED: lambda f: (
        f"the speed is {f.value:.4g} mm/s, which is not above 0; give a positive F (mm/min)"
    ),
    FaultKind.TOO_FAR: lambda f: (
        f"the move ends {f.value:.6g} mm from the middle, more than {f.high:.6g} mm; correct the program or "
        f"{f.options}"
    ),
    FaultKind.TOO_NEAR: lambda f: (
        f"the move passes the middle at {f.value:.6g} mm, nearer than {f.low:.6g} mm, which the arm cannot "
        "reach; go around it"
    ),
}


SPEED_LIMITS = (
    "max_velocity",
    "max_x_velocity",
    "max_y_velocity",
    "max_z_velocity",
    "max_extrude_only_velocity",
)
"""By PLANNER_LIMIT_...: options of the configuration."""


@dataclass(frozen=True, slots=True)
class Slowed:
    """Moves that ask for a higher speed than a limit allows; they are made at that limit."""

    limit: str
    """One of SPEED_LIMITS, the lowest of those that apply to the move."""
    moves: int
    first_line: int
    worst_line: int
    """Of the move that loses the largest share of its speed."""
    asked_mm_s: float
    """Along that move."""
    allowed_mm_s: float


@dataclass(frozen=True, slots=True)
class Trapezoids:
    """Consecutive trapezoids in the planner's memory: valid until they are released."""

    pointer: Any
    """``struct trapezoid *``; another cffi module takes it through its own ``ffi.cast``."""
    count: int
    memory: Any
    """Buffer of the whole planner; keeps it alive."""
    offset: int
    """Of the first trapezoid in ``memory``, bytes."""


def check_number(
    what: str, value: float, low: float, high: float = math.inf, *, open_low: bool = False
) -> float:
    """Return VALUE when it is a finite number within the bounds, else raise ValueError naming WHAT."""
    if not (math.isfinite(value) and low <= value <= high) or (open_low and value == low):
        bound = f"above {low:g}" if open_low else f"at least {low:g}"
        raise ValueError(f"{what} is {value!r}; it must be a number {bound} and at most {high:g}")
    return value


_RANGES: Final = {
    "tower_radius": (0, 1e6),
    "tower_rod": (0, 1e6),
    "cone_top": (-1e6, 1e6),
    "minimum_cruise_ratio": (0, 0.999),
    "max_extrude_ratio": (0, 1e12),
}
"""Of limits that are no speeds and the like."""


def check_limits(limits: MotionLimits) -> None:
    """Refuse limits the arithmetic cannot stand: they would come out as NaN.

    Within these every duration and square is far from overflow and underflow.
    """
    may_be_zero = {"square_corner_velocity", "instantaneous_corner_velocity", "max_radius", "radius_min"}
    may_be_zero |= {"max_extrude_only_distance"}  # a machine without an extruder
    may_be_zero |= {f"max_{axis}_{what}" for axis in "xy" for what in ("velocity", "accel")}
    for field in fields(limits):
        if field.name == "range_options":
            continue
        value = getattr(limits, field.name)
        if field.name in {"position_min", "position_max"}:
            for bound in value:
                check_number(field.name, bound, -1e6, 1e9)
        elif field.name == "cone_slope":
            for slope in value:
                check_number(field.name, slope, 0, 1e6)
        else:
            least = 0 if field.name in may_be_zero else 1e-3
            check_number(field.name, value, *_RANGES.get(field.name, (least, 1e9)))
