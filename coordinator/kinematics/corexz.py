"""CoreXZ: as CoreXY, with the belts crossed over X and Z.

a = x + z, c = x - z, and so x = (a + c) / 2, z = (a - c) / 2. Source: as corexy.py, with Z for Y.
"""

from dataclasses import dataclass

from coordinator.kinematics.base import AxesKinematics, Point, StepFunction, linear


@dataclass(frozen=True, slots=True)
class CoreXZ(AxesKinematics):
    """Rail x has the motor that moves by x + z, rail z the one that moves by x - z."""

    name = "corexz"

    def step_functions(self) -> tuple[StepFunction, ...]:
        """Return the rails' functions."""
        return (linear(x=1, z=1), linear(y=1), linear(x=1, z=-1))

    def inverse(self, point: Point) -> tuple[float, ...]:
        """Return the rails' positions."""
        x, y, z = point
        return (x + z, y, x - z)

    def forward(self, positions: tuple[float, ...]) -> Point:
        """Return the head's place."""
        a, b, c = positions
        return ((a + c) / 2, b, (a - c) / 2)
