"""Hybrid CoreXY (Markforged): Y has motors of its own, the belt of X runs over the moving gantry.

The belt that moves the head along X is carried along Y by the gantry: a = x - y, b = y, and so x = a + b.
Source: the way of a belt whose free length is x - y, as described for the Markforged printers.
"""

from dataclasses import dataclass
from typing import ClassVar

from coordinator.kinematics.base import AxesKinematics, Point, StepFunction, linear


@dataclass(frozen=True, slots=True)
class HybridCoreXY(AxesKinematics):
    """Rail x has the motor that moves by x - y; rail y moves y alone."""

    name = "hybrid_corexy"
    second_carriages: ClassVar = {"x": linear(x=1, y=1)}
    """The second belt runs the other way round."""

    def step_functions(self) -> tuple[StepFunction, ...]:
        """Return the rails' functions."""
        return (linear(x=1, y=-1), linear(y=1), linear(z=1))

    def inverse(self, point: Point) -> tuple[float, ...]:
        """Return the rails' positions."""
        x, y, z = point
        return (x - y, y, z)

    def forward(self, positions: tuple[float, ...]) -> Point:
        """Return the head's place."""
        a, b, c = positions
        return (a + b, b, c)
