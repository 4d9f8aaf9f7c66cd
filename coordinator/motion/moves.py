"""Planned moves in bytes: consecutive struct trapezoid of the planner (motion/trapezoid.h).

numpy sees the same memory by ``trapezoid_array``; what always runs does without it, since numpy takes 10 MB.
"""

import struct
from collections.abc import Iterator
from typing import Any, Final, NamedTuple

from coordinator.motion.planner._planner import ffi

_LAYOUT: Final = struct.Struct("@7d4d4ddq")
_BEGIN: Final = struct.Struct("@4d")
MOVE_BYTES: Final = _LAYOUT.size
_DOUBLE_BYTES: Final = 8
_BEGIN_Z: Final = 9
"""Which double of a move it is."""
assert ffi.sizeof("struct trapezoid") == MOVE_BYTES

Four = tuple[float, float, float, float]


class Move(NamedTuple):
    """A struct trapezoid: its fields, with its units."""

    print_time: float
    accel_s: float
    cruise_s: float
    decel_s: float
    start_v: float
    cruise_v: float
    accel: float
    start: Four
    """X Y Z E, mm."""
    ratio: Four
    pressure_advance: float
    line: int

    def to_bytes(self) -> bytes:
        """Return it as a struct trapezoid."""
        head, (start, ratio, *tail) = self[:7], self[7:]
        return _LAYOUT.pack(*head, *start, *ratio, *tail)


def copied(trapezoids: Any, count: int) -> bytes:
    """Return COUNT moves from a cffi pointer to them, of any module."""
    return bytes(ffi.buffer(trapezoids, count * MOVE_BYTES))


def begin_times_s(moves: bytes) -> "memoryview[float]":
    """Return the print time at which each of MOVES begins."""
    return memoryview(moves).cast("d")[:: MOVE_BYTES // _DOUBLE_BYTES]


def end_s(moves: bytes, index: int) -> float:
    """Return the print time at which the move INDEX of MOVES ends."""
    return float(sum(_BEGIN.unpack_from(moves, index * MOVE_BYTES)))


def read_move(moves: bytes, index: int) -> Move:
    """Return the move INDEX of MOVES."""
    return _move(_LAYOUT.unpack_from(moves, index * MOVE_BYTES))


def read_moves(moves: bytes) -> Iterator[Move]:
    """Yield each of MOVES."""
    return map(_move, _LAYOUT.iter_unpack(moves))


def begin_heights_mm(moves: bytes) -> "memoryview[float]":
    """Return the Z at which each of MOVES begins."""
    return memoryview(moves).cast("d")[_BEGIN_Z :: MOVE_BYTES // _DOUBLE_BYTES]


def _move(values: tuple[Any, ...]) -> Move:
    return Move._make((*values[:7], values[7:11], values[11:15], *values[15:]))
