"""From G-code text to trapezoids: the Python side of the look-ahead and the G-code hot path.

Text goes in by ``feed``, trapezoids come out by ``take`` and ``release``; everything between runs in C
without the interpreter lock. Lengths in mm, times in s, speeds in mm/s, axes in the order X Y Z E.
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import fields
from typing import Any, Final

from coordinator.motion.planner._planner import ffi, lib
from coordinator.motion.planner.language import (
    ARC_DEVIATION_MM,
    ARC_PIECE_MM,
    AXES,
    COMMAND_KINDS,
    ArcFault,
    Plane,
    SuspendedProgram,
    gcode_words,
)
from coordinator.motion.planner.values import (
    SPEED_LIMITS,
    Fault,
    FaultKind,
    Feed,
    FeedStatus,
    PlannerState,
    Position,
    Slowed,
    Trapezoids,
    check_limits,
    check_number,
)
from coordinator.motion.specs import MotionLimits

__all__ = [
    "AXIS_LETTERS",
    "DEFAULT_SPEED_MM_S",
    "MOVE_LETTERS",
    "RING_TRAPEZOIDS",
    "Fault",
    "FaultKind",
    "Feed",
    "FeedStatus",
    "Planner",
    "PlannerState",
    "Position",
    "Slowed",
    "Trapezoids",
]

AXIS_LETTERS = "XYZE"
MOVE_LETTERS = "XYZEF"
_STATUS = tuple(FeedStatus)
MAX_ADVANCE_S: Final = 10.0
_HOMED: Final = ("", "X", "Y", "XY", "Z", "XZ", "YZ", "XYZ")
"""By the planner's mask."""
EXTRUDER_LIMITS: Final = (
    "max_extrude_only_velocity",
    "max_extrude_only_accel",
    "max_extrude_only_distance",
    "max_extrude_ratio",
    "instantaneous_corner_velocity",
)
FILAMENT_ALONE: Final = ("max_extrude_only_velocity", "max_extrude_only_accel")
AXIS_LIMITS: Final = tuple(f"max_{axis}_{what}" for axis in "xyz" for what in ("velocity", "accel"))
DEFAULT_SPEED_MM_S = 25.0
"""Speed of moves before the first F word."""
RING_TRAPEZOIDS = int(lib.PLANNER_RING)
"""Most trapezoids that can wait for ``take``."""


class Planner:
    """Plans moves with look-ahead; begins at standstill at POSITION, print time 0, nothing homed.

    Not thread-safe; ``feed`` releases the interpreter lock while C works. Raises ValueError when a limit is
    not a number it can calculate with.
    """

    def __init__(self, limits: MotionLimits, *, position: Position = (0.0, 0.0, 0.0, 0.0)) -> None:
        check_limits(limits)
        self._limits: Any = ffi.new(
            "struct planner_limits *",
            {f.name: getattr(limits, f.name) for f in fields(limits) if f.name != "range_options"},
        )
        self._core: Any = ffi.new("struct planner *")
        self._memory: Any = ffi.buffer(self._core)
        self._address = int(ffi.cast("uintptr_t", self._core))
        lib.planner_init(self._core, self._limits, position)
        self._state: Any = ffi.new(
            "struct gcode_state *",
            {
                "position": position,
                "unit": 1.0,
                "speed": DEFAULT_SPEED_MM_S,
                "speed_factor": 1.0,
                "extrude_factor": 1.0,
            },
        )
        self._offset: Any = ffi.new("size_t *")
        self._count: Any = ffi.new("uint32_t *")
        self.limits = limits
        """What was configured; ``accel`` and the like never exceed it."""
        self._extruder_limits = limits
        """What was configured for the active extruder."""
        self._offset_mm = [0.0, 0.0, 0.0, 0.0]
        self._z_shift_mm = 0.0
        self.set_arc_precision()

    # ---- Text in ----

    def feed(self, data: bytes | bytearray | memoryview, start: int, end: int, *, final: bool) -> Feed:
        """Plan the lines of DATA[start:end] up to the first that is not the planner's.

        FINAL: no more text comes behind END, so the last line may lack its line feed.
        """
        if not 0 <= start <= end <= len(data):
            raise ValueError(f"{start}..{end} is not a range of {len(data)} bytes")
        self._offset[0] = start
        with ffi.from_buffer(data) as text:
            status = lib.gcode_feed(self._state, self._core, text, end, self._offset, final)
        return Feed(_STATUS[status], self._offset[0], self._state.lines + 1)

    def line_done(self) -> None:
        """Count a line that the caller consumed."""
        self._state.lines += 1

    def move(self, words: Mapping[str, float]) -> FeedStatus:
        """Act on a G1 with these WORDS (letters of MOVE_LETTERS); NEED_DATA says that it was done."""
        if not lib.planner_ready(self._core):
            return FeedStatus.FULL
        refused = lib.gcode_move(self._state, self._core, gcode_words(words))
        return FeedStatus.LIMIT if refused else FeedStatus.NEED_DATA

    def move_to(self, target: Sequence[float], speed_mm_s: float) -> FeedStatus:
        """Move to TARGET (X Y Z E, mm) in the machine's frame, whatever the program's frame and modes are.

        Answers as ``move``; the program's own position follows.
        """
        if not lib.planner_ready(self._core):
            return FeedStatus.FULL
        if lib.planner_add(self._core, target, speed_mm_s):
            return FeedStatus.LIMIT
        self._state.position = self.toolhead_position
        return FeedStatus.NEED_DATA

    @property
    def fault(self) -> Fault:
        """Why the last refused move was refused."""
        fault = self._core.fault
        options = (*self.limits.range_options, "")[fault.axis]
        kind, axis = FaultKind(fault.kind), AXIS_LETTERS[fault.axis]
        return Fault(kind, axis, fault.value, fault.low, fault.high, options)

    def end_exclusion(self, retracted_mm: float, speed_mm_s: float) -> FeedStatus:
        """Make moves again, after some were left out: the program goes on from where the filament is.

        RETRACTED_MM: by how much it was drawn back when they began to be; it gets drawn back by as much as
        the program has it now. Answers as ``move``.
        """
        if not lib.planner_ready(self._core):
            return FeedStatus.FULL
        change = retracted_mm - self.retracted_mm
        if abs(change) > 1e-9:
            x, y, z, e = self.toolhead_position
            if lib.planner_add(self._core, (x, y, z, e + change), speed_mm_s):
                return FeedStatus.LIMIT
        self.match_filament()
        self.excluded = False
        return FeedStatus.NEED_DATA

    # ---- Trapezoids out ----

    def plan(self) -> None:
        """Hand out all that no later move can change; ``feed`` does so when it runs out of data."""
        lib.planner_plan(self._core)

    def take(self) -> Trapezoids:
        """Return the oldest trapezoids that lie in one piece, without copying them; 0 when none waits."""
        pointer = lib.planner_peek(self._core, self._count)
        offset = int(ffi.cast("uintptr_t", pointer)) - self._address
        return Trapezoids(pointer, self._count[0], self._memory, offset)

    def release(self, count: int) -> None:
        """Give the oldest COUNT trapezoids back."""
        if count < 0 or lib.planner_release(self._core, count):
            raise ValueError(f"{count} trapezoids released, but fewer were waiting")

    # ---- Standstill ----

    def flush(self) -> bool:
        """Plan all moves to a standstill; False when the ring is full (take some, call again)."""
        return bool(lib.planner_flush(self._core))

    @property
    def at_standstill(self) -> bool:
        """Whether every move is handed out and the last ends at rest."""
        return bool(self._core.head == self._core.tail)

    def dwell(self, seconds: float) -> None:
        """Stand still for SECONDS more; ``flush`` first."""
        self._standing(lib.planner_wait(self._core, check_number("the dwell", seconds, 0)))

    def begin_at(self, print_time_s: float) -> None:
        """Begin the next move at PRINT_TIME_S, at the earliest ``print_time_end_s``; ``flush`` first."""
        self._standing(lib.planner_begin_at(self._core, check_number("the print time", print_time_s, 0)))

    def set_position(self, position: Sequence[float]) -> None:
        """Declare that the machine stands at POSITION (X Y Z E); ``flush`` first."""
        for value in position:
            check_number("the position", value, -1e9, 1e9)
        self._standing(lib.planner_set_position(self._core, position))
        self._state.position = position

    @staticmethod
    def _standing(failed: int) -> None:
        if failed:
            raise RuntimeError("moves are still queued: flush() first")

    # ---- Time ----

    @property
    def print_time_end_s(self) -> float:
        """Print time at which the last trapezoid handed out ends."""
        return float(self._core.print_time)

    @property
    def plan_until_s(self) -> float:
        """Print time beyond which ``feed`` answers FULL although the ring has room; for streaming."""
        return float(self._core.plan_until)

    @plan_until_s.setter
    def plan_until_s(self, print_time_s: float) -> None:
        if math.isnan(print_time_s):
            raise ValueError("plan_until_s is not a number")
        self._core.plan_until = print_time_s

    # ---- Where things are ----

    def state(self) -> PlannerState:
        """Return what programs can read of the planner, as it is now."""
        core, state, limits = self._core, self._state, self._core.limits
        return PlannerState(
            toolhead_position=self.toolhead_position,
            gcode_position=self.gcode_position,
            gcode_base=self.gcode_base,
            gcode_offset=self.gcode_offset,
            homed=self.homed,
            speed_mm_s=state.speed,
            speed_factor=state.speed_factor,
            extrude_factor=state.extrude_factor,
            unit_mm=state.unit,
            relative=bool(state.relative),
            relative_extrusion=bool(state.relative_extrude),
            max_velocity=limits.max_velocity,
            accel=core.accel,
            minimum_cruise_ratio=limits.minimum_cruise_ratio,
            square_corner_velocity=limits.square_corner_velocity,
            print_time_end_s=core.print_time,
            limits=self.limits,
        )

    @property
    def toolhead_position(self) -> Position:
        """End of the last move added, in the machine's frame."""
        x, y, z, e = self._core.position
        return (x, y, z, e)

    @property
    def gcode_position(self) -> Position:
        """Last target in the frame and units of the G-code program."""
        s = self._state
        x, y, z, e = s.position
        base_x, base_y, base_z, base_e = s.base
        unit = s.unit
        return (
            (x - base_x) / unit,
            (y - base_y) / unit,
            (z - base_z) / unit,
            (e - base_e) / (unit * s.extrude_factor),
        )

    @property
    def gcode_base(self) -> Position:
        """Machine position of the G-code origin, but for ``z_shift_mm``."""
        x, y, z, e = self._state.base
        return (x, y, z - self._z_shift_mm, e)

    def set_gcode_position(self, words: Mapping[str, float]) -> None:
        """G92: the present position shall read as WORDS (axis letter to program units)."""
        s = self._state
        for letter, value in words.items():
            axis = AXIS_LETTERS.index(letter)
            scale = s.unit * (s.extrude_factor if letter == "E" else 1)
            s.base[axis] = s.position[axis] - value * scale

    @property
    def homed(self) -> str:
        """Letters of the homed axes; only these may move. E needs no homing."""
        return _HOMED[self._core.homed & 0b111]

    @homed.setter
    def homed(self, axes: str) -> None:
        self._core.homed = sum(1 << "XYZ".index(letter) for letter in set(axes))

    # ---- State of the G-code language ----

    @property
    def unit_mm(self) -> float:
        """Length of a program unit, mm (G20, G21)."""
        return float(self._state.unit)

    @unit_mm.setter
    def unit_mm(self, unit: float) -> None:
        self._state.unit = check_number("the unit", unit, 0, 1e3, open_low=True)

    @property
    def relative(self) -> bool:
        """G91: all axes, E too, count from where they are."""
        return bool(self._state.relative)

    @relative.setter
    def relative(self, relative: bool) -> None:
        self._state.relative = relative

    @property
    def relative_extrusion(self) -> bool:
        """M83: E counts from where it is."""
        return bool(self._state.relative_extrude)

    @relative_extrusion.setter
    def relative_extrusion(self, relative: bool) -> None:
        self._state.relative_extrude = relative

    @property
    def speed_mm_s(self) -> float:
        """The last F, before the speed factor."""
        return float(self._state.speed)

    @speed_mm_s.setter
    def speed_mm_s(self, speed_mm_s: float) -> None:
        self._state.speed = check_number("the speed", speed_mm_s, 0)

    @property
    def speed_factor(self) -> float:
        """M220 / 100."""
        return float(self._state.speed_factor)

    @speed_factor.setter
    def speed_factor(self, factor: float) -> None:
        self._state.speed_factor = check_number("the speed factor", factor, 0, 100, open_low=True)

    @property
    def extrude_factor(self) -> float:
        """M221 / 100; changing it leaves the G-code position of E as it reads."""
        return float(self._state.extrude_factor)

    @extrude_factor.setter
    def extrude_factor(self, factor: float) -> None:
        check_number("the extrude factor", factor, 0, 100, open_low=True)
        reads = self.gcode_position[3]
        self._state.extrude_factor = factor
        self.set_gcode_position({"E": reads})

    # ---- Modes ----

    def reset_modes(self) -> None:
        """Take units, modes, speed, dynamics and limits of axes back to where a program begins.

        Positions, the G-code origin, what is homed and the factors (M220, M221) stay.
        """
        self.unit_mm = 1.0
        self.relative = self.relative_extrusion = False
        self.drop_exclusion()
        self.plane = Plane.XY
        self._state.speed = DEFAULT_SPEED_MM_S
        self.reset_dynamics()

    def reset_dynamics(self) -> None:
        """Take velocities, accelerations and limits of axes back to the configured ones."""
        self.accel = self.limits.max_accel
        self.max_velocity = self.limits.max_velocity
        self.square_corner_velocity = self.limits.square_corner_velocity
        self.minimum_cruise_ratio = self.limits.minimum_cruise_ratio
        self._take_limits(self.limits, AXIS_LIMITS)
        self._take_limits(self._extruder_limits, EXTRUDER_LIMITS)

    def _take_limits(self, limits: MotionLimits, names: Iterable[str]) -> None:
        for name in names:
            setattr(self._core.limits, name, getattr(limits, name))

    # ---- Speeds, accelerations and ranges; speeds in mm/s ----

    @property
    def accel(self) -> float:
        """mm/s² of moves with filament (M204); setting it sets ``travel_accel``, too."""
        return float(self._core.accel)

    @accel.setter
    def accel(self, accel: float) -> None:
        self.set_accel_words({"S": accel})

    @property
    def travel_accel(self) -> float:
        """mm/s² of moves without filament (M204 T)."""
        return float(self._core.travel_accel)

    @travel_accel.setter
    def travel_accel(self, accel: float) -> None:
        self.set_accel_words({"T": accel})

    def set_accel_words(self, words: Mapping[str, float]) -> None:
        """M204: S of all moves, P of those with filament, T of others; the lower of P and T of all."""
        most = self.limits.max_accel
        capped = {key: min(check_number("the acceleration", a, 1e-3), most) for key, a in words.items()}
        if lib.gcode_accel(self._core, gcode_words(capped)):
            raise ValueError("M204 names no acceleration; give S, or P and T (mm/s²)")

    @property
    def max_velocity(self) -> float:
        """mm/s along the path."""
        return float(self._core.limits.max_velocity)

    @max_velocity.setter
    def max_velocity(self, velocity: float) -> None:
        velocity = check_number("the velocity", velocity, 1e-3)
        self._core.limits.max_velocity = min(velocity, self.limits.max_velocity)

    @property
    def square_corner_velocity(self) -> float:
        """mm/s."""
        return float(self._core.limits.square_corner_velocity)

    @square_corner_velocity.setter
    def square_corner_velocity(self, velocity: float) -> None:
        velocity = check_number("the square corner velocity", velocity, 0)
        self._core.limits.square_corner_velocity = min(velocity, self.limits.square_corner_velocity)

    @property
    def minimum_cruise_ratio(self) -> float:
        """0 <= ratio < 1."""
        return float(self._core.limits.minimum_cruise_ratio)

    @minimum_cruise_ratio.setter
    def minimum_cruise_ratio(self, ratio: float) -> None:
        self._core.limits.minimum_cruise_ratio = check_number("the minimum cruise ratio", ratio, 0, 0.999)

    @property
    def pressure_advance(self) -> float:
        """Seconds, of the printing moves to come."""
        return float(self._core.pressure_advance)

    @pressure_advance.setter
    def pressure_advance(self, advance_s: float) -> None:
        self._core.pressure_advance = check_number("the pressure advance", advance_s, 0, MAX_ADVANCE_S)

    # ---- Where and how the moves to come may go when the machine changes ----

    def set_range(self, axis: int, low: float, high: float) -> None:
        """AXIS (0 to 2) may go from LOW to HIGH, mm; nowhere when LOW is above HIGH."""
        self._core.limits.position_min[axis] = check_number("position_min", low, -1e6, 1e9)
        self._core.limits.position_max[axis] = check_number("position_max", high, -1e6, 1e9)

    def limit_axes(self, what: str, values: Mapping[str, float]) -> None:
        """Limit X, Y, Z and filament alone (E) to VALUES of WHAT: ``velocity`` or ``accel``; mm, s.

        Never more than is configured; raises ValueError.
        """
        for letter, asked in values.items():
            name = f"max_extrude_only_{what}" if letter == "E" else f"max_{letter.lower()}_{what}"
            most = getattr(self.limits, name) or getattr(self.limits, f"max_{what}")
            setattr(self._core.limits, name, min(check_number(name, asked, 1e-3), most))

    @property
    def axis_limits(self) -> dict[str, float]:
        """The limits of X, Y, Z and of filament alone that hold now, by their names; mm, s."""
        return {name: float(getattr(self._core.limits, name)) for name in (*AXIS_LIMITS, *FILAMENT_ALONE)}

    @axis_limits.setter
    def axis_limits(self, limits: Mapping[str, float]) -> None:
        for name, limit in limits.items():
            setattr(self._core.limits, name, limit)

    @property
    def cold(self) -> bool:
        """Whether moves of filament are refused."""
        return bool(self._core.cold)

    @cold.setter
    def cold(self, cold: bool) -> None:
        self._core.cold = cold

    def set_extruder_limits(self, limits: MotionLimits) -> None:
        """Take over what LIMITS say of filament: another extruder is active."""
        check_limits(limits)
        self._extruder_limits = limits
        self._take_limits(limits, EXTRUDER_LIMITS)

    # ---- Offsets ----

    @property
    def gcode_offset(self) -> Position:
        """Shift of the G-code origin in addition to that of G92 (SET_GCODE_OFFSET), mm; homing keeps it."""
        x, y, z, e = self._offset_mm
        return (x, y, z, e)

    def set_gcode_offset(self, words: Mapping[str, float]) -> None:
        """Shift the G-code origin, so that its offset is WORDS (axis letter to mm)."""
        for letter, value in words.items():
            axis = AXES.index(letter)
            offset_mm = check_number("the offset", value, -1e6, 1e6)
            self._state.base[axis] += offset_mm - self._offset_mm[axis]
            self._offset_mm[axis] = offset_mm

    def clear_gcode_base(self, axes: str) -> None:
        """Put the G-code origin of AXES (letters) back to the machine's, but for the offset."""
        for letter in axes:
            axis = AXES.index(letter)
            self._state.base[axis] = self._offset_mm[axis]
            if letter == "Z":
                self._z_shift_mm = 0.0

    def restore_origin(self, base: Position, offset: Position) -> None:
        """Take back an origin (``gcode_base``, mm) and the offset that is in it."""
        self._state.base = base
        self._state.base[2] += self._z_shift_mm
        self._offset_mm = list(offset)

    @property
    def z_shift_mm(self) -> float:
        """How much higher moves are than the program says and ``gcode_base`` shows; homing Z ends it."""
        return self._z_shift_mm

    @z_shift_mm.setter
    def z_shift_mm(self, shift_mm: float) -> None:
        by_mm = shift_mm - self._z_shift_mm
        self._z_shift_mm = shift_mm
        self._state.base[2] += by_mm
        self._state.position[2] += by_mm

    def shift_program(self, axis: str, distance_mm: float) -> None:
        """Add DISTANCE_MM along AXIS to the next move, without a move of its own."""
        self._state.position[AXES.index(axis)] += distance_mm

    # ---- Arcs ----

    def set_arc_precision(
        self, piece_mm: float = ARC_PIECE_MM, deviation_mm: float = ARC_DEVIATION_MM
    ) -> None:
        """Make arcs of straight pieces, none longer nor further away from its arc than this."""
        self._state.arc_piece = check_number("the piece of an arc", piece_mm, 1e-3)
        self._state.arc_deviation = check_number("the deviation of an arc", deviation_mm, 1e-6)

    @property
    def plane(self) -> Plane:
        """G17, G18, G19."""
        return Plane(self._state.plane)

    @plane.setter
    def plane(self, plane: Plane) -> None:
        self._state.plane = int(plane)

    @property
    def arc_open(self) -> bool:
        """Whether an arc is planned in part only; ``feed`` goes on with it."""
        return bool(self._state.arc.done < self._state.arc.pieces)

    def begin_arc(self, words: Mapping[str, float], *, clockwise: bool) -> ArcFault | None:
        """Begin a G2 or G3 with these WORDS (letters of ARC_LETTERS); ``go_on_with_arc`` then."""
        fault = lib.gcode_arc_begin(self._state, self._core, gcode_words(words), clockwise)
        return ArcFault(fault) if fault else None

    def go_on_with_arc(self) -> FeedStatus:
        """Plan what is left of the arc; NEED_DATA says that it was done."""
        return FeedStatus(lib.gcode_arc_go_on(self._state, self._core))

    def suspend_program(self, *, moving: bool = True) -> SuspendedProgram:
        """Suspend the present line, so that other lines can be run; MOVING: they may move.

        Then moves that are left out are made until the line resumes.
        """
        state = self._state
        arc = bytes(ffi.buffer(ffi.addressof(state, "arc")))
        x, y, z, e = state.position
        excluded = moving and self.excluded
        real_e = self._core.position[3]
        suspended = SuspendedProgram(
            state.lines, state.left_out, arc, excluded, (x, y, z, e), state.base[3], real_e
        )
        self.forget_line()
        if excluded:
            self.drop_exclusion()
        return suspended

    def resume_program(self, suspended: SuspendedProgram) -> None:
        """Go on with the line that was suspended."""
        self._state.lines, self._state.left_out = suspended.lines, suspended.left_out
        if suspended.excluded:
            self.excluded = True
            self._state.position, self._state.base[3] = suspended.position, suspended.base_e
        ffi.buffer(ffi.addressof(self._state, "arc"))[:] = suspended.arc
        if not suspended.excluded:  # filament that others moved meanwhile is none of the arc's
            moved_e = self._core.position[3] - suspended.real_e
            self._state.arc.start[3] += moved_e
            self._state.arc.target[3] += moved_e

    def forget_line(self) -> None:
        """Forget what is left of a line: another program begins."""
        self._state.lines = self._state.arc.pieces = self._state.arc.done = 0

    # ---- The height of what is printed ----

    def watch_height(self, z_mm: float | None) -> None:
        """Let ``feed`` stop before a move that prints at another height than Z_MM; None: no longer."""
        self._state.tower = lib.GCODE_NO_TOWER if z_mm is None else lib.GCODE_TOWER
        self._state.tower_z = 0.0 if z_mm is None else z_mm

    @property
    def new_height_mm(self) -> float | None:
        """The height for which ``feed`` has stopped, in the machine's frame; None: it did not."""
        return float(self._state.tower_next_z) if self._state.tower == lib.GCODE_TOWER_DUE else None

    # ---- What is left out ----

    @property
    def excluded(self) -> bool:
        """Whether moves are only followed, and not made."""
        return bool(self._state.excluded)

    @excluded.setter
    def excluded(self, excluded: bool) -> None:
        self._state.excluded = excluded

    @property
    def retracted_mm(self) -> float:
        """By how much the filament of the program is drawn back from where it was most forward."""
        return float(self._state.filament_top - self._state.position[3])

    @property
    def filament_mm(self) -> float:
        """How much the program has pushed forward: the furthest that E came."""
        return float(self._state.filament_top)

    def match_filament(self) -> None:
        """Set the program's filament position to the real one."""
        state = self._state
        shift = self._core.position[3] - state.position[3]
        state.position[3] += shift
        state.base[3] += shift
        state.filament_top += shift

    def leave_out_from(self, place: Position) -> None:
        """Leave out moves from here on; the program's position becomes PLACE, wherever the head is."""
        self._state.position = place
        self.excluded = True

    def drop_exclusion(self) -> None:
        """Make moves again from where the machine is, and let the program know it."""
        if self.excluded:
            self.match_filament()
            self._state.position = self._core.position
            self.excluded = False

    def leave_out(self, commands: Iterable[str]) -> None:
        """Leave the lines of COMMANDS, of those that ``feed`` acts on, to the caller."""
        self._state.left_out = 0
        for kind in {COMMAND_KINDS[command] for command in commands if command in COMMAND_KINDS}:
            self._state.left_out |= 1 << kind

    # ---- Counters ----

    @property
    def lines(self) -> int:
        """Lines consumed; set it where another program begins or goes on."""
        return int(self._state.lines)

    @lines.setter
    def lines(self, lines: int) -> None:
        self._state.lines = lines

    @property
    def moves(self) -> int:
        """Moves added."""
        return int(self._core.moves_added)

    @property
    def moves_dropped(self) -> int:
        """Moves shorter than 1 nm, which were dropped."""
        return int(self._core.moves_dropped)

    @property
    def slowed(self) -> tuple[Slowed, ...]:
        """Moves that the limits made slower than they asked for, by limit; without those that did not."""
        return tuple(
            Slowed(name, s.moves, s.first_line, s.worst_line, s.asked, s.allowed)
            for name, s in zip(SPEED_LIMITS, self._core.slowed, strict=True)
            if s.moves
        )

    @property
    def moves_overflowed(self) -> int:
        """Moves planned before they were settled because the queue was full."""
        return int(self._core.moves_overflowed)
