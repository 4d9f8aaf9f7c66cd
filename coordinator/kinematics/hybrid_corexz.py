"""Hybrid CoreXZ: Z has motors of its own, the belt of X runs over the lifted gantry.

a = x - z, c = z, and so x = a + c. Source: as hybrid_corexy.py, with Z for Y.
"""

from dataclasses import dataclass
from typing import ClassVar

from coordinator.kinematics.base import AxesKinematics, Point, StepFunction, linear


@dataclass(frozen=True, slots=True)
class HybridCoreXZ(AxesKinematics):
    """Rail x has the motor that moves by x - z; rail z moves z alone."""

    name = "hybrid_corexz"
    second_carriages: ClassVar = {"x": linear(x=1, z=1)}
    """The second belt runs the other way round."""

    def step_functions(self) -> tuple[StepFunction, ...]:
        """Return the rails' functions."""
        return (linear(x=1, z=-1), linear(y=1), linear(z=1))

    def inverse(self, point: Point) -> tuple[float, ...]:
        """Return the rails' positions."""
        x, y, z = point
        return (x - z, y, z)

    def forward(self, positions: tuple[float, ...]) -> Point:
        """Return the head's place."""
        a, b, c = positions
        return (a + c, b, c)
