"""Deltesian: two upright towers left and right hold the head by rods and move X and Z; Y is cartesian.

A tower stands at ax (left: negative), its rod is A long: u = z + √(A² - (ax - x)²). Forward, with the
carriages at heights u and w: the head is the lower of the points where the circles of radius A around (ax,
u) and (bx, w) meet. Source: delta.py in two dimensions.

Step generation takes the formula deltesian (deltesian.c) with params (A², ax).
"""

import math
from dataclasses import dataclass

from coordinator.kinematics.base import Kinematics, Point, StepFunction, WorkSpace, linear


@dataclass(frozen=True, slots=True)
class Arm:
    """One tower with its rod."""

    x: float
    """Of the tower, less the distance between the head's joint and the nozzle; negative: left."""
    rod_length: float
    endstop_height: float
    """Z of the head in the middle when the carriage is at its endstop."""


@dataclass(frozen=True, slots=True)
class Deltesian(Kinematics):
    """A deltesian."""

    left: Arm
    right: Arm
    y_range: tuple[float, float]
    min_z: float = 0.0
    min_angle: float = math.radians(5)
    """Smallest angle between a rod and the horizontal."""
    print_width: float | None = None
    """Of X, centred; None: as far as min_angle allows."""
    name = "deltesian"
    even_along_z = True
    rails = ("left", "right", "y")
    homing_order = (("left", "right"), ("y",))

    def step_functions(self) -> tuple[StepFunction, ...]:
        """Return the rails' functions."""
        towers = (StepFunction("deltesian", params=(a.rod_length**2, a.x), axes="xz") for a in self._arms)
        return (*towers, linear(y=1))

    def inverse(self, point: Point) -> tuple[float, ...]:
        """Return the carriages' heights and Y; ValueError where a rod is too short."""
        x, y, z = point
        return (*(z + math.sqrt(arm.rod_length**2 - (arm.x - x) ** 2) for arm in self._arms), y)

    def forward(self, positions: tuple[float, ...]) -> Point:
        """Return the head's place; ValueError when the rods do not meet."""
        left, right, y = positions
        dx, dz = self.right.x - self.left.x, right - left
        distance2 = dx * dx + dz * dz
        # From the left joint towards the right one, then across.
        share = (self.left.rod_length**2 - self.right.rod_length**2 + distance2) / (2 * distance2)
        across = math.sqrt(self.left.rod_length**2 / distance2 - share * share)
        return (self.left.x + share * dx + across * dz, y, left + share * dz - across * dx)

    @property
    def _arms(self) -> tuple[Arm, Arm]:
        return (self.left, self.right)

    @property
    def widest(self) -> float:
        """How far from the middle the head may be before a rod lies too flat."""
        return min(arm.rod_length * math.cos(self.min_angle) - abs(arm.x) for arm in self._arms)

    @property
    def endstop_positions(self) -> tuple[float, ...]:
        """Where the carriages' endstops are."""
        return tuple(arm.endstop_height + math.sqrt(arm.rod_length**2 - arm.x**2) for arm in self._arms)

    @property
    def work_space(self) -> WorkSpace:
        """The box in which no carriage overruns its endstop; see delta.py."""
        widest = self.widest
        half = widest if self.print_width is None else self.print_width / 2
        top = min(
            end - math.sqrt(arm.rod_length**2 - max(abs(arm.x) - half, 0.0) ** 2)
            for arm, end in zip(self._arms, self.endstop_positions, strict=True)
        )
        slope = max(abs(arm.x) / math.sqrt(arm.rod_length**2 - arm.x**2) for arm in self._arms)
        low, high = (-half, self.y_range[0], self.min_z), (half, self.y_range[1], top)
        cone_top = min(arm.endstop_height for arm in self._arms)
        return WorkSpace(low, high, cone_slope=(slope, 0.0), cone_top=cone_top)
