"""Cable winches: the head hangs on, or is pulled by, cables from winches at fixed anchors.

A cable's length is the distance between its anchor and the head: u = √((ax - x)² + (ay - y)² + (az - z)²).
Forward: three cables leave two points, one on each side of the plane of their anchors; further cables tell
which one it is, and without any the head hangs below the plane. Source: Euclidean distance, trilateration
(geometry.py).

Step generation takes WINCH with params (ax, ay, az).
"""

import math
from dataclasses import dataclass

from coordinator.kinematics.base import Point, StepFunction, WorkSpace
from coordinator.kinematics.geometry import spheres_meet
from coordinator.motion.specs import StepKinematics

MIN_WINCHES = 3


@dataclass(frozen=True, slots=True)
class Winch:
    """A machine of three winches or more; the first three anchors are not on one line."""

    anchors: tuple[Point, ...]
    name = "winch"
    homing_order: tuple[tuple[str, ...], ...] = ()
    """No cable can be homed on an endstop: the head is put where G28 shall find it."""

    @property
    def rails(self) -> tuple[str, ...]:
        """One letter per winch."""
        return tuple(chr(ord("a") + i) for i in range(len(self.anchors)))

    def step_functions(self) -> tuple[StepFunction, ...]:
        """Return the cables' functions."""
        return tuple(StepFunction(StepKinematics.WINCH, params=anchor) for anchor in self.anchors)

    def inverse(self, point: Point) -> tuple[float, ...]:
        """Return the cables' lengths."""
        return tuple(math.dist(anchor, point) for anchor in self.anchors)

    def forward(self, positions: tuple[float, ...]) -> Point:
        """Return the head's place; ValueError when the first three cables do not meet."""
        a, b, c, *others = self.anchors
        lower, upper = spheres_meet((a, b, c), (positions[0], positions[1], positions[2]))

        def misfit(point: Point) -> float:
            return sum(
                abs(math.dist(anchor, point) - u) for anchor, u in zip(others, positions[3:], strict=True)
            )

        return lower if misfit(lower) <= misfit(upper) else upper

    @property
    def work_space(self) -> WorkSpace:
        """The box around all anchors."""
        x, y, z = (tuple(anchor[axis] for anchor in self.anchors) for axis in range(3))
        return WorkSpace((min(x), min(y), min(z)), (max(x), max(y), max(z)))
