"""Generic cartesian: each motor moves by a sum of the axes that the configuration gives.

With the rows of a matrix M being the motors' weights, u = M·p. Forward takes the first three independent
rows: p = M₃⁻¹·u₃; further motors (a second belt of one axis) follow from the head. Source: linear algebra.
"""

import itertools
from collections.abc import Iterator
from dataclasses import dataclass, replace

from coordinator.kinematics.base import Kinematics, Point, StepFunction, WorkSpace, linear
from coordinator.kinematics.geometry import cross, dot, solve

MIN_INDEPENDENCE = 1e-6
"""Smallest determinant of three motors' weights, each scaled to length 1, that counts as independent."""


@dataclass(frozen=True, slots=True)
class GenericCartesian(Kinematics):
    """Any machine whose motors move by sums of the axes."""

    motors: tuple[tuple[str, Point], ...]
    """Each motor's name and its way per mm of X, Y and Z."""
    box: WorkSpace
    carriages: tuple[tuple[str, int], ...] = ()
    """Names, each with the axis (0 to 2) that it runs on."""
    name = "generic_cartesian"
    homing_order = (("x",), ("y",), ("z",))
    """Of axes here: a motor is no rail with an endstop of its own."""

    @property
    def work_space(self) -> WorkSpace:
        """The box that the carriages' ranges span."""
        return self.box

    @property
    def rails(self) -> tuple[str, ...]:
        """The motors' names."""
        return tuple(name for name, _ in self.motors)

    def step_functions(self) -> tuple[StepFunction, ...]:
        """Return the motors' functions."""
        return tuple(linear(*weights) for _, weights in self.motors)

    def with_motors(self, motors: tuple[tuple[str, Point], ...]) -> "GenericCartesian":
        """Return the machine with these motors."""
        return replace(self, motors=motors)

    def inverse(self, point: Point) -> tuple[float, ...]:
        """Return the motors' positions."""
        return tuple(dot(weights, point) for _, weights in self.motors)

    def forward(self, positions: tuple[float, ...]) -> Point:
        """Return the head's place; ValueError when the motors do not determine it."""
        chosen = next(self._independent(), None)
        if chosen is None:
            raise ValueError("the motors do not move X, Y and Z independently")
        a, b, c = (self.motors[i][1] for i in chosen)
        return solve((a, b, c), (positions[chosen[0]], positions[chosen[1]], positions[chosen[2]]))

    @property
    def independent(self) -> bool:
        """Whether the motors determine where the head is."""
        return next(self._independent(), None) is not None

    def _independent(self) -> Iterator[tuple[int, ...]]:
        for chosen in itertools.combinations(range(len(self.motors)), 3):
            a, b, c = (self.motors[i][1] for i in chosen)
            scale = (dot(a, a) * dot(b, b) * dot(c, c)) ** 0.5
            if abs(dot(a, cross(b, c))) > MIN_INDEPENDENCE * scale:
                yield chosen
