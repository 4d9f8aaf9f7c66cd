"""An axis table: what has to be added to an axis's commanded position so that it really is there.

A correction may differ by the direction of travel (backlash, the screw's other flank). Between two points it
is linear; beyond the ends the last one holds.
"""

import bisect
import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import Final

from nodes.mt.mt import VALUES, Pair
from nodes.support.errors import CanductorError

X_PER_UNIT: Final = 10_000
"""MT's X: 100 nm, or 0.0001 degrees."""
Y_PER_UNIT: Final = 1_000_000
"""MT's Y: 1 nm, or 0.000001 degrees."""
POINTS: Final = range(2, 10_001)
SLOPE_MAX: Final = 0.02
"""Change of the correction over the way: a screw that is wrong by more than 2 % is no screw."""
CORRECTION_MAX: Final = 5.0


Point = tuple[float, float, float]
"""A position, and the corrections there for travel forward and in reverse."""


class TableError(CanductorError):
    """A table that no axis can have; one sentence, with file and line where it comes from one."""


class Unit(StrEnum):
    """What positions and corrections are in."""

    MM = "mm"
    DEG = "deg"


class Direction(StrEnum):
    """Of travel."""

    FORWARD = "forward"
    """To larger positions."""
    REVERSE = "reverse"


@dataclass(frozen=True, slots=True, kw_only=True)
class AxisTable:
    """The table of AXIS; raises TableError for one that cannot be.

    POSITIONS ascend; FORWARD and REVERSE are the corrections there, for travel in either direction, all in
    UNIT and finite. Neighbours differ by at most SLOPE_MAX of the way between them.
    """

    axis: str
    unit: Unit = Unit.MM
    positions: tuple[float, ...]
    forward: tuple[float, ...]
    reverse: tuple[float, ...]

    def __post_init__(self) -> None:
        """Check it."""
        count = len(self.positions)
        if count not in POINTS or len(self.forward) != count or len(self.reverse) != count:
            raise TableError(
                f"the table of axis {self.axis} has {count} positions, {len(self.forward)} forward and "
                f"{len(self.reverse)} reverse corrections; give {POINTS[0]} to {POINTS[-1]} of each, as many"
            )
        before = None
        for number, point in enumerate(zip(self.positions, self.forward, self.reverse, strict=True), 1):
            if problem := problem_of(self.unit, point, before):
                raise TableError(f"the table of axis {self.axis}, point {number}: {problem}")
            before = point

    def corrections(self, direction: Direction) -> tuple[float, ...]:
        """Return the corrections for travel in DIRECTION."""
        return self.forward if direction is Direction.FORWARD else self.reverse

    def correction(self, position: float, direction: Direction) -> float:
        """Return what is to be added to POSITION when it is reached in DIRECTION."""
        values = self.corrections(direction)
        index = bisect.bisect_right(self.positions, position)
        if index == 0 or index == len(values):
            return values[max(0, index - 1)]
        x0, x1 = self.positions[index - 1], self.positions[index]
        share = (position - x0) / (x1 - x0)
        return values[index - 1] + share * (values[index] - values[index - 1])

    def pairs(self, direction: Direction) -> list[Pair]:
        """Return it as MT carries it, for one of the axis's two axles: X in 100 nm, Y in nm."""
        values = self.corrections(direction)
        return [
            (round(x * X_PER_UNIT), round(y * Y_PER_UNIT))
            for x, y in zip(self.positions, values, strict=True)
        ]

    @property
    def symmetric(self) -> bool:
        """Whether the direction of travel makes no difference."""
        return self.forward == self.reverse


def problem_of(unit: Unit, point: Point, before: Point | None) -> str:
    """Return what is wrong with a POINT of a table as it follows the one BEFORE; empty: nothing."""
    return _bad_values(unit, point) or ("" if before is None else _bad_step(unit, point, before))


def _bad_values(unit: Unit, point: Point) -> str:
    x, *values = point
    if not all(map(math.isfinite, point)):
        return "a value is not finite; give numbers"
    if abs(x) * X_PER_UNIT > VALUES[-1]:
        return f"the position {x:g} {unit} is beyond {VALUES[-1] / X_PER_UNIT:g} {unit}; check the unit"
    worst = max(values, key=abs)
    if abs(worst) > CORRECTION_MAX:
        return (
            f"a correction of {worst:g} {unit} is beyond {CORRECTION_MAX:g} {unit}; check the unit, and"
            " whether the file gives actual positions (type 0) or corrections (type 1)"
        )
    return ""


def _bad_step(unit: Unit, point: Point, before: Point) -> str:
    x, x0 = point[0], before[0]
    if round(x * X_PER_UNIT) <= round(x0 * X_PER_UNIT):
        return (
            f"the position {x:g} {unit} follows {x0:g} {unit}; positions must ascend by at least"
            f" {1 / X_PER_UNIT:g} {unit}"
        )
    for side, value, value0 in zip(Direction, point[1:], before[1:], strict=True):
        slope = (value - value0) / (x - x0)
        if abs(slope) > SLOPE_MAX:
            return (
                f"the {side} correction changes by {slope:.3g} {unit} per {unit}, more than {SLOPE_MAX:g}; a"
                " screw does not: check the unit, and this point"
            )
    return ""


def notes(table: AxisTable, low: float | None, high: float | None) -> list[str]:
    """Return sentences about TABLE on an axis that travels from LOW to HIGH (None: not known).

    Raises TableError when it cannot be this axis's.
    """
    first, last = table.positions[0], table.positions[-1]
    if low is None or high is None:
        return []
    if last < low or first > high:
        raise TableError(
            f"the table of axis {table.axis} covers {first:g} to {last:g} {table.unit}, but the axis travels "
            f"from {low:g} to {high:g} {table.unit}; check the unit and the axis"
        )
    if first > low or last < high:
        note = (
            f"axis {table.axis} travels from {low:g} to {high:g} {table.unit}, the table covers {first:g} to "
            f"{last:g}; beyond it the corrections at its ends hold"
        )
        return [note]
    return []


def figures(table: AxisTable) -> dict[str, float | int | str]:
    """Return what one wants to know of a table at a glance, by name."""
    both = (*table.forward, *table.reverse)
    lost = [abs(f - r) for f, r in zip(table.forward, table.reverse, strict=True)]
    return {
        "axis": table.axis,
        "unit": str(table.unit),
        "points": len(table.positions),
        "first": table.positions[0],
        "last": table.positions[-1],
        "least_correction": min(both),
        "greatest_correction": max(both),
        "greatest_slope": max(map(abs, (*_slopes(table, table.forward), *_slopes(table, table.reverse)))),
        "greatest_backlash": max(lost),
        "between_points": round(max(_between(table, table.forward), _between(table, table.reverse)), 9),
    }


def _between(table: AxisTable, values: Sequence[float]) -> float:
    """Return about how far a line between two points is off, at most, as the table bends at its points."""
    slopes = _slopes(table, values)
    ways = [b - a for a, b in itertools.pairwise(table.positions)]
    bends = (
        abs(after - before) / (w0 + w1) * max(w0, w1) ** 2 / 4
        for (before, after), (w0, w1) in zip(
            itertools.pairwise(slopes), itertools.pairwise(ways), strict=True
        )
    )
    return max(bends, default=0.0)


def _slopes(table: AxisTable, values: Sequence[float]) -> list[float]:
    ways = (b - a for a, b in itertools.pairwise(table.positions))
    return [(b - a) / way for (a, b), way in zip(itertools.pairwise(values), ways, strict=True)]
