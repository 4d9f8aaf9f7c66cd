"""Machines with one rail per axis, whose positions are sums of the axes.

With the rows of a matrix M being the rails' weights, u = M·p and p = M⁻¹·u. Source: linear algebra.
"""

from dataclasses import dataclass
from typing import ClassVar

from coordinator.kinematics.base import Kinematics, Point, StepFunction, WorkSpace
from coordinator.kinematics.geometry import dot, solve


@dataclass(frozen=True, slots=True)
class AxesKinematics(Kinematics):
    """A kinematics with one rail per axis; subclasses only say what each rail follows."""

    box: WorkSpace
    functions: ClassVar[tuple[StepFunction, StepFunction, StepFunction]]
    """Of the rails x, y and z."""
    rails = ("x", "y", "z")
    homing_order = (("x",), ("y",), ("z",))

    @property
    def work_space(self) -> WorkSpace:
        """The box that the axes span."""
        return self.box

    def step_functions(self) -> tuple[StepFunction, ...]:
        """Return the rails' functions."""
        return self.functions

    def inverse(self, point: Point) -> tuple[float, ...]:
        """Return the rails' positions."""
        return tuple(dot(function.weights[:3], point) for function in self.functions)

    def forward(self, positions: tuple[float, ...]) -> Point:
        """Return the head's place."""
        a, b, c = (function.weights[:3] for function in self.functions)
        x, y, z = positions
        return solve((a, b, c), (x, y, z))
