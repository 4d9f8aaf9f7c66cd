"""Words of the G-code language that the planner knows: planes, faults of arcs, words as C takes them."""

from collections.abc import Mapping
from dataclasses import dataclass
from enum import IntEnum
from typing import Any, Final

from coordinator.motion.planner._planner import ffi, lib
from coordinator.motion.planner.values import Position

AXES: Final = "XYZE"
ARC_LETTERS: Final = "XYZEFIJKR"
_LETTERS: Final = "XYZEFSPTIJKR"
ARC_PIECE_MM: Final = 1.0
ARC_DEVIATION_MM: Final = 0.005
COMMAND_KINDS: Final[Mapping[str, int]] = {
    "G0": lib.GCODE_MOVE,
    "G1": lib.GCODE_MOVE,
    "G2": lib.GCODE_ARC_CW,
    "G3": lib.GCODE_ARC_CCW,
    "G92": lib.GCODE_ORIGIN,
    "M204": lib.GCODE_ACCEL,
}


READ_IN_C: Final = tuple(COMMAND_KINDS)
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
    SPEED = lib.GCODE_ARC_SPEED
    HUGE = lib.GCODE_ARC_HUGE

    def __str__(self) -> str:
        """Say what is wrong and what to do, as the end of a sentence."""
        return _ARC_FAULTS[self]


_ARC_FAULTS: Final[Mapping[ArcFault, str]] = {
    ArcFault.NO_CENTER: "needs its center, either as I, J or K of its plane or as the radius R",
    ArcFault.RADIUS: "has a radius R that does not reach from its start to its end; correct the program",
    ArcFault.UNEQUAL: "has a center that is not as far from its end as from its start; correct the program",
    ArcFault.SPEED: "has a speed F below 0; give a positive F (mm/min)",
    ArcFault.HUGE: "is too large; correct the program",
}


@dataclass(frozen=True, slots=True)
class SuspendedProgram:
    """How far the present line was, while other lines are run."""

    lines: int
    left_out: int
    arc: bytes
    excluded: bool
    position: Position
    base_e: float
    real_e: float
    """Of the machine, not of the program."""


def gcode_words(words: Mapping[str, float]) -> Any:
    """Return WORDS (values by letter) as a struct gcode_words."""
    given: Any = ffi.new("struct gcode_words *")
    for letter, value in words.items():
        index = _LETTERS.index(letter)
        given.value[index] = value
        given.given |= 1 << index
    return given
