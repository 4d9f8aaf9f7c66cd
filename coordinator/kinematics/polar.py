"""Polar: the bed turns, an arm moves the head away from the bed's middle, Z is cartesian.

Bed: angle = atan2(y, x), unwrapped along the way; arm: radius = √(x² + y²). Forward: x = r·cos φ, y = r·sin
φ. Source: polar coordinates.

At the middle the angle is not defined, and near it the bed would have to turn infinitely fast: a machine
that must not go there has an arm whose position_min is above 0.
"""

import math
from dataclasses import dataclass

from coordinator.kinematics.base import Kinematics, Point, StepFunction, WorkSpace, linear


@dataclass(frozen=True, slots=True)
class Polar(Kinematics):
    """A polar machine."""

    arm_range: tuple[float, float]
    """Smallest and largest distance of the head from the middle; a smallest one below 0 counts as 0."""
    z_range: tuple[float, float]
    name = "polar"
    rails = ("bed", "arm", "z")
    homing_order = (("arm",), ("z",))

    def homed_letters(self, group: tuple[str, ...]) -> str:
        """Return X and Y for the arm: the bed's angle counts as 0 from then on."""
        return "XY" if group == ("arm",) else Kinematics.homed_letters(self, group)

    def step_functions(self) -> tuple[StepFunction, ...]:
        """Return the rails' functions."""
        return (
            StepFunction("polar_angle", axes="xy", turns=True),
            StepFunction("polar_radius", axes="xy"),
            linear(z=1),
        )

    def inverse(self, point: Point) -> tuple[float, ...]:
        """Return the bed's angle (-π to π), the arm's way and Z."""
        x, y, z = point
        return (math.atan2(y, x), math.hypot(x, y), z)

    def forward(self, positions: tuple[float, ...]) -> Point:
        """Return the head's place."""
        angle, radius, z = positions
        return (radius * math.cos(angle), radius * math.sin(angle), z)

    @property
    def work_space(self) -> WorkSpace:
        """A cylinder, perhaps with a hole."""
        inner, outer = self.arm_range
        (low, high), hole = self.z_range, max(inner, 0.0)
        return WorkSpace((-outer, -outer, low), (outer, outer, high), max_radius=outer, radius_min=hole)
