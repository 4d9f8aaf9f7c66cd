"""What of the machine a program may change while it runs: extruders, carriages, shapers, pressure advance.

A ``MachineState`` is what holds for the lines to come; the events that ``machine_commands`` emits carry each
change to step generation at its print time.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field

from coordinator.gcode.tuning_tower import TuningTower
from coordinator.kinematics.base import Weights
from coordinator.kinematics.dual_carriage import CarriageState, DualCarriage
from coordinator.kinematics.extruder import ExtruderMotion
from coordinator.motion.planner.planner import Position
from coordinator.motion.specs import MotionLimits
from coordinator.motion.steps.surface import Surface

SHAPER_AXES = "XYZ"
DEFAULT_STATE = "default"
"""The name of a saved state, where none is given."""
SHAPER_PERIODS = 2.0
"""No shaper is wider than this many periods of its frequency."""


@dataclass(frozen=True, slots=True)
class Shaper:
    """How an axis is shaped."""

    kind: str = "mzv"
    frequency_hz: float = 0.0
    """0: the axis is not shaped."""
    damping_ratio: float = 0.1

    @property
    def width_s(self) -> float:
        """No wider than this."""
        return SHAPER_PERIODS / self.frequency_hz if self.frequency_hz else 0.0


@dataclass(slots=True)
class Extruder:
    """What a program may change of one extruder."""

    name: str
    limits: MotionLimits
    pressure_advance_s: float = 0.0
    smooth_s: float = 0.0
    """The window over which its advance is spread."""
    window_s: float = 0.0
    """The window in effect: without any advance so far there is none."""
    place_mm: float = 0.0
    """Where its E stood in the program's frame when it was last active, mm."""

    def __post_init__(self) -> None:
        if self.pressure_advance_s:
            self.window_s = self.smooth_s


@dataclass(frozen=True, slots=True)
class SavedState:
    """What holds for the lines to come, as SAVE_GCODE_STATE found it; X Y Z E, mm."""

    position: tuple[float, float, float, float]
    """In the machine's frame."""
    base: tuple[float, float, float, float]
    offset: tuple[float, float, float, float]
    unit_mm: float
    relative: bool
    relative_extrusion: bool
    speed_mm_s: float
    speed_factor: float
    extrude_factor: float
    homed: str = ""
    """Letters of the axes that were homed."""


@dataclass(slots=True)
class MachineState:
    """What the machine is like for the next line."""

    extruders: dict[str, Extruder] = field(default_factory=dict)
    """By name; tool Tn is the n-th."""
    filament: ExtruderMotion | None = None
    """Which steppers move with the active extruder; None on a machine without one."""
    carriages: DualCarriage | None = None
    carriage_state: CarriageState | None = None
    """None on a machine with one carriage."""
    shapers: dict[str, Shaper] = field(default_factory=dict)
    """By axis letter."""
    saved: dict[str, SavedState] = field(default_factory=dict)
    """By name."""
    saved_carriages: dict[str, CarriageState] = field(default_factory=dict)
    """By name."""
    follows: Mapping[str, Weights] = field(default_factory=dict)
    """What motors (by name) follow whose axes are corrected; others follow what they are described to."""
    surface: Surface | None = None
    """The shape of the bed that Z follows; None: a plane."""
    tower: TuningTower | None = None
    """A value that changes with the height of what is printed."""

    @property
    def active(self) -> Extruder | None:
        """The extruder that E stands for."""
        return self.extruders[self.filament.active] if self.filament and self.filament.active else None

    def motor_position(self, planned: Position) -> Position:
        """Return where the motors have the head at a PLANNED place: with the shape of the bed."""
        x, y, z, e = planned
        return planned if self.surface is None else (x, y, self.surface.motor_z(x, y, z), e)

    def planned_position(self, motors: Position) -> Position:
        """Return the place that is planned where MOTORS have the head at one."""
        x, y, z, e = motors
        return motors if self.surface is None else (x, y, self.surface.planned_z(x, y, z), e)

    def tool(self, number: int) -> Extruder | None:
        """Return the extruder of tool NUMBER, or None."""
        every = list(self.extruders.values())
        return every[number] if number < len(every) else None

    def settle_s(self, shapers: Mapping[str, Shaper] | None = None, smooth_s: float = 0.0) -> float:
        """Return for how long steps may go on after the last move, also with other SHAPERS and SMOOTH_S."""
        widths = [shaper.width_s for shaper in (*self.shapers.values(), *(shapers or {}).values())]
        smooth = [extruder.window_s for extruder in self.extruders.values()]
        return max([0.0, smooth_s, *widths, *smooth])
