"""The shape of a bed from heights on a grid: pure.

Between its points a mesh is a smooth surface (coordinator/motion/steps/surface.py) that goes through all of
them. ``lagrange``: along each axis the polynomial through all points. ``bicubic``: cubics whose slope at a
point is TENSION times the difference of its neighbours; an even tilt stays one, whatever the tension.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from coordinator.motion.steps.surface import NO_FADE, Surface

Place = tuple[float, float]
"""X and Y, mm."""
Floats = NDArray[np.float64]

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

    heights: Floats
    minimum: Place
    maximum: Place
    algorithm: str = LAGRANGE
    tension: float = 0.2
    pps: tuple[int, int] = (2, 2)
    """Points that ``fine_heights`` has between two measured ones."""

    @property
    def counts(self) -> tuple[int, int]:
        """Points along X and along Y."""
        rows, columns = self.heights.shape
        return columns, rows

    @property
    def spacing(self) -> Place:
        """Between points along X and along Y, mm."""
        return (
            (self.maximum[0] - self.minimum[0]) / (self.counts[0] - 1),
            (self.maximum[1] - self.minimum[1]) / (self.counts[1] - 1),
        )

    def surface(self, fade: tuple[float, float, float] = NO_FADE, offset: Place = (0.0, 0.0)) -> Surface:
        """Return the surface; heights are looked up OFFSET further. Raises StepError when it is no bed's."""
        plane = self._plane()
        rest = self.heights - plane
        (value_x, slope_x, parts), (value_y, slope_y, _) = (self._along(count) for count in self.counts)
        width, depth = self.spacing
        slope_x, slope_y = slope_x / width, slope_y / depth
        nodes = np.stack(
            (
                value_y @ rest @ value_x.T,
                value_y @ rest @ slope_x.T,
                slope_y @ rest @ value_x.T,
                slope_y @ rest @ slope_x.T,
            ),
            axis=-1,
        )
        nodes[..., 0] += self._plane(parts)
        nodes[..., 1] += (plane[0, -1] - plane[0, 0]) / (self.maximum[0] - self.minimum[0])
        nodes[..., 2] += (plane[-1, 0] - plane[0, 0]) / (self.maximum[1] - self.minimum[1])
        origin = (self.minimum[0] - offset[0], self.minimum[1] - offset[1])
        return Surface(origin, (width / parts, depth / parts), nodes, fade)

    def fine_heights(self) -> Floats:
        """Return the heights of the surface with ``pps`` more points between two measured ones."""
        surface = self.surface()
        columns, rows = (
            (count - 1) * (more + 1) + 1 for count, more in zip(self.counts, self.pps, strict=True)
        )
        xs = np.linspace(self.minimum[0], self.maximum[0], columns)
        ys = np.linspace(self.minimum[1], self.maximum[1], rows)
        return np.array([[surface.motor_z(x, y, 0.0) for x in xs] for y in ys])

    def _plane(self, parts: int = 1) -> Floats:
        """Return the plane nearest to the heights, at the points or PARTS times as close."""
        columns, rows = self.counts
        x, y = np.meshgrid(np.linspace(-1, 1, columns), np.linspace(-1, 1, rows))
        terms = np.stack((np.ones_like(x), x, y), axis=-1).reshape(-1, 3)
        factors = np.linalg.lstsq(terms, self.heights.reshape(-1), rcond=None)[0]
        fine_x = np.linspace(-1, 1, (columns - 1) * parts + 1)
        fine_y = np.linspace(-1, 1, (rows - 1) * parts + 1)
        plane: Floats = factors[0] + factors[1] * fine_x + factors[2] * fine_y[:, None]
        return plane

    def _along(self, count: int) -> tuple[Floats, Floats, int]:
        """Return matrices from COUNT heights in a row to nodes' heights and slopes; nodes per point."""
        if self.algorithm == LAGRANGE:
            at = np.arange((count - 1) * LAGRANGE_PARTS + 1) / LAGRANGE_PARTS
            powers = np.arange(count)
            known = np.linalg.inv(np.vander(powers.astype(float), count, increasing=True))
            slopes = np.zeros((len(at), count))
            slopes[:, 1:] = powers[1:] * np.vander(at, count - 1, increasing=True)
            return np.vander(at, count, increasing=True) @ known, slopes @ known, LAGRANGE_PARTS
        slopes = self.tension * (np.eye(count, k=1) - np.eye(count, k=-1))
        slopes[0, :2] = slopes[-1, -2:] = (-2 * self.tension, 2 * self.tension)
        return np.eye(count), slopes, 1


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

    def heights(self, measured: Callable[[Place], float]) -> Floats:
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
            heights = np.interp(
                range(len(points)), there, [sum(known[column]) / len(known[column]) for column in there]
            )
            rows.append(heights)
        return np.array(rows)


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
