"""Straight lines through measured points, read in both directions."""

import itertools
from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import dataclass

from nodes.support.errors import CanductorError


class TableError(CanductorError):
    """Points that no line can be drawn through."""


@dataclass(frozen=True, slots=True)
class Line:
    """Straight lines through points with rising x and rising or falling y; beyond the ends they go on."""

    x: tuple[float, ...]
    y: tuple[float, ...]

    @classmethod
    def through(cls, points: Sequence[tuple[float, float]]) -> "Line":
        """Return the line through two or more POINTS (x, y) in any order; TableError where y turns back."""
        ordered = sorted(points)
        if len(ordered) < 2:
            raise TableError("at least two points are needed")
        x, y = zip(*ordered, strict=True)
        steps = {(y1 > y0) - (y1 < y0) for y0, y1 in itertools.pairwise(y)}
        if any(x0 == x1 for x0, x1 in itertools.pairwise(x)):
            raise TableError("two points have the same temperature")
        if steps not in ({1}, {-1}):
            raise TableError("from point to point all values must rise, or all must fall")
        return cls(x, y)

    def at(self, x: float) -> float:
        """Return y at X."""
        return _between(self.x, self.y, x)

    def where(self, y: float) -> float:
        """Return the x at which the line has the value Y."""
        if self.y[0] < self.y[-1]:
            return _between(self.y, self.x, y)
        return _between(self.y[::-1], self.x[::-1], y)


def _between(x: tuple[float, ...], y: tuple[float, ...], at: float) -> float:
    piece = min(max(bisect_right(x, at), 1), len(x) - 1)
    x0, x1, y0, y1 = x[piece - 1], x[piece], y[piece - 1], y[piece]
    return y0 + (at - x0) * (y1 - y0) / (x1 - x0)
