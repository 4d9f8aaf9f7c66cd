"""Cartesian: each rail moves one axis. Formulas: none, a rail's position is the axis' position."""

from dataclasses import dataclass
from typing import ClassVar

from coordinator.kinematics.base import AxesKinematics, Point, StepFunction, linear


@dataclass(frozen=True, slots=True)
class Cartesian(AxesKinematics):
    """Three axes with motors of their own."""

    name = "cartesian"
    second_carriages: ClassVar = {"x": linear(x=1), "y": linear(y=1)}

    def step_functions(self) -> tuple[StepFunction, ...]:
        """Return the rails' functions."""
        return (linear(x=1), linear(y=1), linear(z=1))

    def inverse(self, point: Point) -> tuple[float, ...]:
        """Return the rails' positions."""
        return point

    def forward(self, positions: tuple[float, ...]) -> Point:
        """Return the head's place."""
        x, y, z = positions
        return (x, y, z)
