"""Where the tool has been since the job began, for front ends that draw: as many points as can be drawn."""

import itertools
from dataclasses import dataclass
from typing import Any, Final

from coordinator.motion.history._history import ffi, lib
from coordinator.motion.moves import MOVE_BYTES

POINTS_MAX = 20_000
KEEP_SHARE = 0.75
"""When it is full, the points that matter least go until this share is left."""
MOVES_AT_ONCE: Final = 256
ROOM_FIRST: Final = 1024
_GENERATIONS = itertools.count(1)
"""Unique in this process: a path that starts again is not taken for the one before."""


@dataclass(frozen=True, slots=True)
class Corners:
    """Consecutive points, by columns."""

    x: list[float]
    """mm, rounded to 0.001, like y and z."""
    y: list[float]
    z: list[float]
    time_s: list[float]
    """Print time when the tool is there, rounded to 0.001 s."""
    extrudes: list[bool]
    """Whether it extruded on the way there."""


class Toolpath:
    """Corners of the path in order; lives on one thread. Points of one ``generation`` keep their numbers."""

    def __init__(self, points_max: int = POINTS_MAX) -> None:
        self._points_max = points_max
        self._keep = int(KEEP_SHARE * points_max)
        self.clear()

    def __len__(self) -> int:
        return self._count

    def clear(self) -> None:
        """Start an empty path."""
        self.generation = next(_GENERATIONS)
        self._count = 0
        self._room = ROOM_FIRST
        self._corners: Any = ffi.new("struct path_corner[]", self._room)

    def add(self, moves: bytes) -> None:
        """Add MOVES (each a struct trapezoid), in order."""
        pointer = ffi.cast("struct trapezoid *", ffi.from_buffer(moves))
        total = len(moves) // MOVE_BYTES
        for first in range(0, total, MOVES_AT_ONCE):
            count = min(MOVES_AT_ONCE, total - first)
            self._make_room(2 * count)
            self._count = lib.toolpath_add(self._corners, self._count, pointer + first, count)
            while self._count > self._points_max:
                self._thin()

    def after(self, first: int, count: int) -> Corners:
        """Return at most COUNT points from number FIRST."""
        count = max(0, min(count, self._count - first))
        columns = [ffi.new("double[]", max(1, count)) for _ in range(4)]
        lib.toolpath_columns(self._corners + first if count else self._corners, count, *columns)
        x, y, z, time_s = ([*ffi.unpack(column, count)] for column in columns)
        extrudes = [bool(self._corners[index].extrude) for index in range(first, first + count)]
        return Corners(x, y, z, time_s, extrudes)

    def _make_room(self, more: int) -> None:
        if self._count + more <= self._room:
            return
        self._room = 2 * (self._count + more)
        grown = ffi.new("struct path_corner[]", self._room)
        ffi.memmove(grown, self._corners, self._count * ffi.sizeof("struct path_corner"))
        self._corners = grown

    def _thin(self) -> None:
        """Drop points, those first that lie next to the line between their neighbours."""
        detours = ffi.new("struct path_detour[]", self._count // 2 + 1)
        self._count = lib.toolpath_thin(self._corners, self._count, self._keep, self._points_max, detours)
        self.generation = next(_GENERATIONS)
