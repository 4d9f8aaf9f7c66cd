"""Surfaces through measured heights, and what motors have to do about them: pure, by least squares."""

from collections.abc import Sequence
from dataclasses import dataclass

from coordinator.kinematics.base import Point
from coordinator.support.lazy_numpy import Numbers, np

Place = tuple[float, float]
"""X and Y, mm."""


@dataclass(frozen=True, slots=True)
class Plane:
    """A height that changes evenly along X and Y."""

    center: Place
    z: float
    """At the center."""
    slope_x: float
    slope_y: float

    def height(self, place: Place) -> float:
        """Return the height at PLACE."""
        return (
            self.z + self.slope_x * (place[0] - self.center[0]) + self.slope_y * (place[1] - self.center[1])
        )


def fit_plane(points: Sequence[Point]) -> Plane:
    """Return the plane that is nearest to POINTS; across points on one line it is level."""
    measured = np.array(points, float)
    x, y, z = measured.mean(axis=0)
    around = measured - (x, y, z)
    slopes = np.linalg.lstsq(around[:, :2], around[:, 2], rcond=None)[0]
    return Plane((float(x), float(y)), float(z), float(slopes[0]), float(slopes[1]))


def bilinear_heights(points: Sequence[Point], places: Sequence[Place]) -> list[float]:
    """Return the heights at PLACES of the surface z = a + b·x + c·y + d·x·y through four POINTS."""
    measured = np.array(points, float)
    center = measured.mean(axis=0)
    size = np.abs(measured - center).max(axis=0)
    factors = np.linalg.lstsq(_terms((measured - center)[:, :2] / size[:2]), measured[:, 2], rcond=None)[0]
    heights = _terms((np.array(places, float) - center[:2]) / size[:2]) @ factors
    return [float(height) for height in heights]


def _terms(places: Numbers) -> Numbers:
    x, y = places[:, 0], places[:, 1]
    return np.stack((np.ones_like(x), x, y, x * y), axis=1)


def rank(places: Sequence[Place]) -> int:
    """Return in how many directions PLACES extend: 0 one place, 1 a line, 2 an area."""
    around = np.array(places, float) - np.mean(places, axis=0)
    return int(np.linalg.matrix_rank(around, tol=1e-3))


def adjustments(heights: Sequence[float]) -> tuple[list[float], float]:
    """Return by how much each motor has to rise where the bed seems to have HEIGHTS, and their mean.

    The motors' mean stays, so they move as little as they can.
    """
    mean = float(np.mean(heights))
    return [height - mean for height in heights], mean


def spread_mm(points: Sequence[Point]) -> float:
    """Return how far apart the heights of POINTS are."""
    heights = [z for _, _, z in points]
    return max(heights) - min(heights)
