"""What the planner keeps of the G-code language beside positions: offsets, arcs, what is left out."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from enum import IntEnum
from typing import Any, Final

from coordinator.motion.planner._planner import ffi, lib
from coordinator.motion.planner.values import FeedStatus, Position, check_number

AXES: Final = "XYZE"
ARC_LETTERS: Final = "XYZEFIJKR"
_LETTERS: Final = "XYZEFSPTIJKR"
ARC_PIECE_MM: Final = 1.0
ARC_DEVIATION_MM: Final = 0.005
_KINDS: Final[Mapping[str, int]] = {
    "G0": lib.GCODE_MOVE,
    "G1": lib.GCODE_MOVE,
    "G2": lib.GCODE_ARC_CW,
    "G3": lib.GCODE_ARC_CCW,
    "G92": lib.GCODE_ORIGIN,
    "M204": lib.GCODE_ACCEL,
}


READ_IN_C: Final = tuple(_KINDS)
"""Commands that ``feed`` acts on."""


class Plane(IntEnum):
    """The plane that arcs lie in."""

    XY = lib.GCODE_XY
    ZX = lib.GCODE_ZX
    YZ = lib.GCODE_YZ


class ArcFault(IntEnum):
    """Why an arc cannot be made."""

    NO_CENTER = lib.GCODE_ARC_NO_CENTER
    RADIUS = lib.GCODE_ARC_RADIUS
    UNEQUAL = lib.GCODE_ARC_UNEQUAL
    HUGE = lib.GCODE_ARC_HUGE

    def __str__(self) -> str:
        """Say what is wrong and what to do, as the end of a sentence."""
        return _ARC_FAULTS[self]


_ARC_FAULTS: Final[Mapping[ArcFault, str]] = {
    ArcFault.NO_CENTER: "needs its center, either as I, J or K of its plane or as the radius R",
    ArcFault.RADIUS: "has a radius R that does not reach from its start to its end; correct the program",
    ArcFault.UNEQUAL: "has a center that is not as far from its end as from its start; correct the program",
    ArcFault.HUGE: "is too large; correct the program",
}


@dataclass(frozen=True, slots=True)
class SuspendedProgram:
    """How far the line at hand was, while other lines come between."""

    lines: int
    left_out: int
    arc: bytes
    excluded: bool
    position: Position
    base_e: float
    real_e: float
    """Of the machine, whatever the program believes."""


def gcode_words(words: Mapping[str, float]) -> Any:
    """Return WORDS (values by letter) as a struct gcode_words."""
    given: Any = ffi.new("struct gcode_words *")
    for letter, value in words.items():
        index = _LETTERS.index(letter)
        given.value[index] = value
        given.given |= 1 << index
    return given


class Language:
    """The part of ``Planner`` that is about the language; STATE is its struct gcode_state."""

    def __init__(self, state: Any, core: Any) -> None:
        self._state = state
        self._core = core
        self._offset_mm = [0.0, 0.0, 0.0, 0.0]
        self.set_arc_precision()

    # ---- Offsets ----

    @property
    def gcode_offset(self) -> Position:
        """By how much the G-code origin is shifted beside G92 (SET_GCODE_OFFSET), mm; homing keeps it."""
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

    def restore_origin(self, base: Position, offset: Position) -> None:
        """Take back an origin (machine's frame, mm) and the offset that is in it."""
        self._state.base = base
        self._offset_mm = list(offset)

    def shift_program(self, axis: str, distance_mm: float) -> None:
        """Let the next move also make up for DISTANCE_MM along AXIS, without a move of its own."""
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
        """Let other lines come before the one at hand goes on; MOVING: they may move.

        Then moves are made again where they are left out, until it goes on.
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
        """Let the program go on from where the filament really is, wherever it believes it to be."""
        state = self._state
        shift = self._core.position[3] - state.position[3]
        state.position[3] += shift
        state.base[3] += shift
        state.filament_top += shift

    def leave_out_from(self, place: Position) -> None:
        """Leave out moves from here on; the program believes the head to be at PLACE, wherever it is."""
        self._state.position = place
        self.excluded = True

    def drop_exclusion(self) -> None:
        """Make moves again from where the machine is, and let the program know it."""
        if self.excluded:
            self.match_filament()
            self._state.position = self._core.position
            self.excluded = False

    def leave_out(self, commands: Iterable[str]) -> None:
        """Let the lines of COMMANDS, of those that ``feed`` acts on, be the caller's instead."""
        self._state.left_out = 0
        for kind in {_KINDS[command] for command in commands if command in _KINDS}:
            self._state.left_out |= 1 << kind
