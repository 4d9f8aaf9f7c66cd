"""The shape of a bed from heights on a grid: pure.

Between its points a mesh is a smooth surface (coordinator/motion/steps/surface.py) that goes through all of
them. ``lagrange``: along each axis the polynomial through all points. ``bicubic``: cubics whose slope at a
point is TENSION times the difference of its neighbours; an even tilt stays one, whatever the tension.
"""

import math
from bisect import bisect_right
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Final

from coordinator.kinematics.geometry import fit_point
from coordinator.motion.steps.surface import NO_FADE, Surface

Place = tuple[float, float]
"""X and Y, mm."""
Heights = tuple[tuple[float, ...], ...]
"""Rows of X, mm."""
Weights = Sequence[tuple[int, float]]
"""Of a node: numbers of points along an axis, with how much each counts."""

LAGRANGE: Final = "lagrange"
BICUBIC: Final = "bicubic"
LAGRANGE_POINTS: Final = range(3, 7)
"""Along an axis: polynomials through more points swing between them."""
BICUBIC_LEAST: Final = 4
LAGRANGE_PARTS: Final = 4
"""Cubics between two points that follow the polynomial, closer than 0.1 % of what it bends there."""


def fitting_algorithm(wanted: str, counts: tuple[int, int]) -> str:
    """Return the algorithm for a grid of so many points; raises ValueError with a sentence.

    Few points of an axis are no use to bicubic: then it is lagrange, as far as that goes.
    """
    if wanted == BICUBIC and min(counts) < BICUBIC_LEAST:
        wanted = LAGRANGE
    if wanted == LAGRANGE and max(counts) not in LAGRANGE_POINTS:
        raise ValueError(
            f"a mesh of {counts[0]}, {counts[1]} points cannot be joined by {LAGRANGE}, which takes"
            f" {LAGRANGE_POINTS[0]} to {LAGRANGE_POINTS[-1]} points an axis; {BICUBIC} takes"
            f" {BICUBIC_LEAST} and more on both"
        )
    return wanted


@dataclass(frozen=True, slots=True, eq=False)
class Mesh:
    """Heights (mm), rows of X, evenly from MINIMUM to MAXIMUM."""

    heights: Heights
    minimum: Place
    maximum: Place
    algorithm: str = LAGRANGE
    tension: float = 0.2
    pps: tuple[int, int] = (2, 2)
    """Points that ``fine_heights`` has between two measured ones."""

    @property
    def counts(self) -> tuple[int, int]:
        """Points along X and along Y."""
        return len(self.heights[0]), len(self.heights)

    @property
    def spacing(self) -> Place:
        """Between points along X and along Y, mm."""
        return (
            (self.maximum[0] - self.minimum[0]) / (self.counts[0] - 1),
            (self.maximum[1] - self.minimum[1]) / (self.counts[1] - 1),
        )

    @property
    def lowest(self) -> float:
        """The least height, mm."""
        return min(map(min, self.heights))

    @property
    def highest(self) -> float:
        """The greatest height, mm."""
        return max(map(max, self.heights))

    @property
    def mean(self) -> float:
        """Of all heights, mm."""
        return sum(map(sum, self.heights)) / math.prod(self.counts)

    @property
    def steepest(self) -> float:
        """The greatest change between neighbouring points, mm per mm."""
        along_x = max(abs(b - a) for row in self.heights for a, b in pairwise(row))
        along_y = max(
            abs(b - a) for low, high in pairwise(self.heights) for a, b in zip(low, high, strict=True)
        )
        return max(along_x / self.spacing[0], along_y / self.spacing[1])

    def surface(self, fade: tuple[float, float, float] = NO_FADE, offset: Place = (0.0, 0.0)) -> Surface:
        """Return the surface; heights are looked up OFFSET further. Raises StepError when it is no bed's."""
        # Heights above the nearest plane: so an even tilt stays one, whatever the tension.
        z, by_column, by_row = self._plane()
        rest = [
            [height - (z + by_column * column + by_row * row) for column, height in enumerate(heights)]
            for row, heights in enumerate(self.heights)
        ]
        along_x, along_y = (self._along(count) for count in self.counts)
        parts = LAGRANGE_PARTS if self.algorithm == LAGRANGE else 1
        width, depth = self.spacing
        nodes = [
            [
                (
                    _sum(rest, value_y, value_x) + z + by_column * column / parts + by_row * row / parts,
                    (_sum(rest, value_y, slope_x) + by_column) / width,
                    (_sum(rest, slope_y, value_x) + by_row) / depth,
                    _sum(rest, slope_y, slope_x) / (width * depth),
                )
                for column, (value_x, slope_x) in enumerate(along_x)
            ]
            for row, (value_y, slope_y) in enumerate(along_y)
        ]
        origin = (self.minimum[0] - offset[0], self.minimum[1] - offset[1])
        return Surface(origin, (width / parts, depth / parts), nodes, fade)

    def fine_heights(self) -> Heights:
        """Return the heights of the surface with ``pps`` more points between two measured ones."""
        surface = self.surface()
        xs, ys = (
            [low + (high - low) * i / ((count - 1) * (more + 1)) for i in range((count - 1) * (more + 1) + 1)]
            for low, high, count, more in zip(self.minimum, self.maximum, self.counts, self.pps, strict=True)
        )
        return tuple(tuple(surface.motor_z(x, y, 0.0) for x in xs) for y in ys)

    def _plane(self) -> tuple[float, float, float]:
        """Return the plane nearest to the heights: at the first point, its rise by column and by row."""
        columns, rows = self.counts
        terms = [(1.0, float(column), float(row)) for row in range(rows) for column in range(columns)]
        return fit_point(terms, [height for row in self.heights for height in row])

    def _along(self, count: int) -> list[tuple[Weights, Weights]]:
        """Return, for each node along an axis of COUNT points, the weights of its height and its slope."""
        if self.algorithm == LAGRANGE:
            return [_lagrange(i / LAGRANGE_PARTS, count) for i in range((count - 1) * LAGRANGE_PARTS + 1)]
        found: list[tuple[Weights, Weights]] = []
        for i in range(count):
            before, after = max(i - 1, 0), min(i + 1, count - 1)
            slope = self.tension * 2 / (after - before)
            found.append((((i, 1.0),), ((before, -slope), (after, slope))))
        return found


def _sum(rest: Sequence[Sequence[float]], rows: Weights, columns: Weights) -> float:
    return sum(by_y * by_x * rest[row][column] for row, by_y in rows for column, by_x in columns)


def _lagrange(at: float, count: int) -> tuple[Weights, Weights]:
    """Return the weights of COUNT points in the polynomial through them and in its slope, at a place.

    The points are 0, 1, 2, …: the basis polynomials of Lagrange, and their derivatives by the product rule.
    """
    values, slopes = [], []
    for j in range(count):
        factors = [((at - m) / (j - m), 1 / (j - m)) for m in range(count) if m != j]
        value, slope = 1.0, 0.0
        for factor, derivative in factors:
            value, slope = value * factor, slope * factor + value * derivative
        values.append((j, value))
        slopes.append((j, slope))
    return values, slopes


# ------------------------------------------------------------------------------------- where it is measured


@dataclass(frozen=True, slots=True)
class Region:
    """A part of the bed that must not be probed."""

    minimum: Place
    maximum: Place

    def contains(self, place: Place) -> bool:
        """Return whether PLACE lies inside."""
        return all(low < at < high for low, at, high in zip(self.minimum, place, self.maximum, strict=True))

    def around(self, place: Place) -> list[Place]:
        """Return the places on its edges to the left and right, in front of and behind PLACE."""
        x, y = place
        return [(self.minimum[0], y), (self.maximum[0], y), (x, self.minimum[1]), (x, self.maximum[1])]


@dataclass(frozen=True, slots=True)
class Grid:
    """Where the points of a mesh are."""

    minimum: Place
    maximum: Place
    counts: tuple[int, int]
    """Along X and Y, at least 3 each."""
    center: Place = (0.0, 0.0)
    radius: float = math.inf
    """Of a round bed: beyond it nothing is probed."""
    regions: tuple[Region, ...] = ()

    def point(self, row: int, column: int) -> Place:
        """Return the place of a point."""
        shares = (column / (self.counts[0] - 1), row / (self.counts[1] - 1))
        x, y = (
            low + (high - low) * share
            for low, high, share in zip(self.minimum, self.maximum, shares, strict=True)
        )
        return (round(x, 6), round(y, 6))

    def is_on_bed(self, place: Place) -> bool:
        """Return whether PLACE is within the grid, and on a round bed."""
        inside = all(
            low <= at <= high for low, at, high in zip(self.minimum, place, self.maximum, strict=True)
        )
        return inside and math.dist(place, self.center) <= self.radius + 1e-6

    def probed(self, point: Place) -> list[Place]:
        """Return where is probed for POINT: there, around a faulty region, or nowhere on this bed."""
        if not self.is_on_bed(point):
            return []
        for region in self.regions:
            if region.contains(point):
                around = [place for place in region.around(point) if self.is_on_bed(place)]
                return [place for place in around if not any(other.contains(place) for other in self.regions)]
        return [point]

    def places(self) -> list[Place]:
        """Return all that is probed, each once, row by row to and fro."""
        found: dict[Place, None] = {}
        for row in range(self.counts[1]):
            columns = range(self.counts[0])
            for column in columns if row % 2 == 0 else reversed(columns):
                found |= dict.fromkeys(self.probed(self.point(row, column)))
        return list(found)

    def heights(self, measured: Callable[[Place], float]) -> Heights:
        """Return the heights of all points from what was MEASURED at ``places``.

        On a round bed a point beyond the edge is as high as the last one of its row. Raises ValueError when
        nothing of a row can be probed.
        """
        rows = []
        for row in range(self.counts[1]):
            points = [self.point(row, column) for column in range(self.counts[0])]
            known = [[measured(place) for place in self.probed(point)] for point in points]
            there = [column for column, found in enumerate(known) if found]
            if not there:
                raise ValueError(
                    f"nothing of the mesh's row at Y {points[0][1]:g} can be probed: faulty regions cover it"
                )
            means = [sum(known[column]) / len(known[column]) for column in there]
            rows.append(tuple(_between(there, means, column) for column in range(len(points))))
        return tuple(rows)


def _between(columns: Sequence[int], heights: Sequence[float], at: int) -> float:
    """Return the height at a column, on straight lines between known ones; beyond them it is level."""
    after = bisect_right(columns, at)
    if after in (0, len(columns)):
        return heights[min(after, len(columns) - 1)]
    low, high = columns[after - 1], columns[after]
    return heights[after - 1] + (heights[after] - heights[after - 1]) * (at - low) / (high - low)


def adapted(grid: Grid, areas: Sequence[Sequence[Place]], margin: float) -> Grid:
    """Return the part of GRID around AREAS (polygons), with as dense points; without areas all of it."""
    places = [place for area in areas for place in area]
    if not places:
        return grid
    axes = []
    for axis in (0, 1):
        values = [place[axis] for place in places]
        low = max(min(values) - margin, grid.minimum[axis])
        high = min(max(values) + margin, grid.maximum[axis])
        if high <= low:  # nothing of it lies on the grid
            return grid
        share = (high - low) / (grid.maximum[axis] - grid.minimum[axis])
        axes.append((low, high, max(3, math.ceil(grid.counts[axis] * share))))
    (x0, x1, columns), (y0, y1, rows) = axes
    # Lagrange cannot join more points of one axis than it can; bicubic needs enough of both.
    if max(columns, rows) > LAGRANGE_POINTS[-1]:
        columns, rows = max(columns, BICUBIC_LEAST), max(rows, BICUBIC_LEAST)
    return Grid((x0, y0), (x1, y1), (columns, rows), grid.center, grid.radius, grid.regions)
