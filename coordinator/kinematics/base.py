"""What every kinematics offers. Lengths in mm, angles in rad; a point is X Y Z of the head.

A *rail* is what one motor, or several side by side, move: an axis, a tower, an arm, a winch. Its position is
what step generation divides by the way per step: mm, or rad where the rail turns.
"""

import math
from dataclasses import dataclass
from typing import Protocol

from coordinator.motion.specs import StepKinematics

Point = tuple[float, float, float]
Weights = tuple[float, float, float, float]

NO_WEIGHTS: Weights = (0.0, 0.0, 0.0, 0.0)
FILAMENT: Weights = (0.0, 0.0, 0.0, 1.0)
"""Of a stepper that moves the filament."""


@dataclass(frozen=True, slots=True)
class StepFunction:
    """How step generation gets a rail's position from the axes; see StepKinematics for the parameters."""

    kinematics: StepKinematics = StepKinematics.LINEAR
    weights: Weights = NO_WEIGHTS
    """Of X Y Z E, where the kinematics is LINEAR."""
    params: tuple[float, ...] = ()

    @property
    def turns(self) -> bool:
        """Whether the position is an angle."""
        return self.kinematics in {StepKinematics.POLAR_ANGLE, StepKinematics.ROTARY_DELTA}


def linear(x: float = 0.0, y: float = 0.0, z: float = 0.0) -> StepFunction:
    """Return a rail whose position is a sum of the axes."""
    return StepFunction(weights=(x, y, z, 0.0))


@dataclass(frozen=True, slots=True)
class WorkSpace:
    """Where the head may be: a box, of which a cylinder around Z may be all that counts, and a cone above.

    Each is convex, so that a straight move between two points of the same one stays within; but for the hole.
    """

    low: Point
    high: Point
    max_radius: float = 0.0
    """Largest distance from the Z axis; 0: the box alone counts."""
    radius_min: float = 0.0
    """Smallest distance from the Z axis: a hole."""
    cone_slope: tuple[float, float] = (0.0, 0.0)
    """Slopes 0: no cone. Else the head may also be above the box, where homing leaves it, in the cone
    z + √((sx·x)² + (sy·y)²) <= cone_top."""
    cone_top: float = 0.0
    tower_radius: float = 0.0
    """Of a delta: how far level its rods reach with the head in the middle."""
    tower_rod: float = 0.0
    """Of a delta: length of its shortest rod, which lies flatter the further the head is out. 0: no delta."""

    def contains(self, point: Point) -> bool:
        """Tell whether the head may be at POINT."""
        radius = math.hypot(point[0], point[1])
        x, y, z = point
        inside = all(a <= p <= b for a, p, b in zip(self.low[:2], (x, y), self.high[:2], strict=True))
        if not self.low[2] <= z <= self.high[2]:
            inside = inside and self._in_cone(point)
        return inside and radius >= self.radius_min and (radius <= self.max_radius or not self.max_radius)

    def _in_cone(self, point: Point) -> bool:
        x, y, z = point
        down = math.hypot(self.cone_slope[0] * x, self.cone_slope[1] * y)
        return any(self.cone_slope) and self.low[2] <= z <= self.cone_top - down


class Kinematics(Protocol):
    """Between the head and its rails. Implementations are frozen values without any state."""

    @property
    def name(self) -> str:
        """As in the configuration."""

    @property
    def rails(self) -> tuple[str, ...]:
        """Names of the rails, in the order in which positions are given and taken."""

    @property
    def homing_order(self) -> tuple[tuple[str, ...], ...]:
        """Rails that are homed one after the other; those of one group move together."""

    @property
    def work_space(self) -> WorkSpace:
        """Where the head may be."""

    def step_functions(self) -> tuple[StepFunction, ...]:
        """Return what step generation computes for each rail."""

    def inverse(self, point: Point) -> tuple[float, ...]:
        """Return the rails' positions with the head at POINT; ValueError where it cannot be."""

    def forward(self, positions: tuple[float, ...]) -> Point:
        """Return where the head is when the rails are at POSITIONS; ValueError where they cannot be."""
