"""Where the tool has been since the job began, for front ends that draw: as many points as can be drawn."""

import itertools

import numpy as np
from numpy.typing import NDArray

from coordinator.service.state.trace import Moves

POINTS_MAX = 20_000
KEEP_SHARE = 0.75
"""When it is full, the points that matter least go until this share is left."""
_SAME_MM = 1e-6
_GENERATIONS = itertools.count(1)
"""Unique in this process: a path that starts again is not taken for the one before."""

Floats = NDArray[np.float64]


class Toolpath:
    """Corners of the path in order; lives on one thread. Points of one ``generation`` keep their numbers."""

    def __init__(self, points_max: int = POINTS_MAX) -> None:
        self._points_max = points_max
        self.clear()

    def __len__(self) -> int:
        return self._count

    def clear(self) -> None:
        """Start an empty path."""
        self._put(np.empty((0, 3)), np.empty(0), np.empty(0, dtype=bool))

    def add(self, moves: Moves) -> None:
        """Add MOVES, in order."""
        if not len(moves):
            return
        start, ratio = moves["start"][:, :3], moves["ratio"]
        end = start + ratio[:, :3] * _length_mm(moves)[:, None]
        end_s = moves["print_time"] + moves["accel_s"] + moves["cruise_s"] + moves["decel_s"]
        last = self._at[self._count - 1 : self._count]
        before = np.vstack((last if len(self) else start[:1] - 1.0, end[:-1]))
        jumps = np.flatnonzero(np.abs(start - before).max(axis=1) > _SAME_MM)
        at, time_s, extrudes = end, end_s, ratio[:, 3] > 0
        if len(jumps):
            at = np.insert(at, jumps, start[jumps], axis=0)
            time_s = np.insert(time_s, jumps, moves["print_time"][jumps])
            extrudes = np.insert(extrudes, jumps, False)
        moved = np.abs(np.diff(np.vstack((last, at)), axis=0)).max(axis=1) > _SAME_MM
        kept = moved if len(self) else np.concatenate(([True], moved))
        self._append(at[kept], time_s[kept], extrudes[kept])
        while len(self) > self._points_max:
            self._thin()

    def after(self, first: int, count: int) -> tuple[Floats, Floats, NDArray[np.bool_]]:
        """Return at most COUNT points from number FIRST.

        Place (mm), print time (s), and whether it extruded on the way there.
        """
        part = slice(first, min(first + count, self._count))
        return self._at[part], self._time_s[part], self._extrudes[part]

    def _put(self, at: Floats, time_s: Floats, extrudes: NDArray[np.bool_]) -> None:
        """Have these points only, by new numbers."""
        self.generation = next(_GENERATIONS)
        self._count = len(at)
        self._at, self._time_s, self._extrudes = at, time_s, extrudes

    def _append(self, at: Floats, time_s: Floats, extrudes: NDArray[np.bool_]) -> None:
        """Add points behind the others, in room made for more: what was given out by ``after`` stays."""
        begin, self._count = self._count, self._count + len(at)
        if self._count > len(self._at):
            room = 2 * self._count - begin
            self._at, self._time_s, self._extrudes = (
                np.concatenate((old[:begin], np.empty((room, *old.shape[1:]), old.dtype)))
                for old in (self._at, self._time_s, self._extrudes)
            )
        self._at[begin : self._count] = at
        self._time_s[begin : self._count] = time_s
        self._extrudes[begin : self._count] = extrudes

    def _thin(self) -> None:
        """Drop every other point at most, those first that lie next to the line between their neighbours."""
        at, extrudes = self._at[: self._count], self._extrudes[: self._count]
        a, b, c = at[:-2:2], at[1:-1:2], at[2::2]
        a, b = a[: len(c)], b[: len(c)]
        chord = c - a
        along = np.einsum("ij,ij->i", b - a, chord) / np.maximum(np.einsum("ij,ij->i", chord, chord), 1e-12)
        away = np.linalg.norm(b - a - np.clip(along, 0, 1)[:, None] * chord, axis=1)
        same = extrudes[1:-1:2][: len(c)] == extrudes[2::2][: len(c)]
        surplus = len(self) - int(KEEP_SHARE * self._points_max)
        order = np.argsort(np.where(same, away, np.inf), kind="stable")[: min(surplus, int(same.sum()))]
        kept = np.ones(len(self), dtype=bool)
        kept[1 + 2 * order] = False
        if kept.sum() > self._points_max:  # all corners matter: the oldest go
            kept[: len(self) - int(KEEP_SHARE * self._points_max)] = False
        self._put(at[kept], self._time_s[: self._count][kept], extrudes[kept])


def _length_mm(moves: Moves) -> Floats:
    a, c, d = moves["accel_s"], moves["cruise_s"], moves["decel_s"]
    accel, cruise_v = moves["accel"], moves["cruise_v"]
    way: Floats = moves["start_v"] * a + accel * a * a / 2 + cruise_v * (c + d) - accel * d * d / 2
    return way
