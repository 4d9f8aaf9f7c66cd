"""Cable winches: the head hangs on, or is pulled by, cables from winches at fixed anchors.

A cable's length is the distance between its anchor and the head: u = √((ax - x)² + (ay - y)² + (az - z)²).
Forward: the differences of the squared lengths of four cables are linear in the head's place, if the anchors
are not in one plane. If all are, three cables leave two points, and the head hangs at the lower one. Source:
Euclidean distance, trilateration (geometry.py).

Step generation takes the formula winch (winch.c) with params (ax, ay, az).
"""

import math
from dataclasses import dataclass

from coordinator.kinematics.base import Kinematics, Point, StepFunction, WorkSpace
from coordinator.kinematics.geometry import along, cross, dot, solve, spheres_meet, subtract

MIN_WINCHES = 3
_FLAT = 1e-3
"""Sine of the angle to the others' plane below which an anchor counts as in it."""
_CLEARANCE = 0.01
"""Share of the anchors' spread that the head stays below their plane."""


@dataclass(frozen=True, slots=True)
class Winch(Kinematics):
    """A machine of three winches or more; the first three anchors are not on one line."""

    anchors: tuple[Point, ...]
    name = "winch"
    homing_order = ()
    """No cable can be homed on an endstop: the head is put where G28 shall find it."""

    @property
    def rails(self) -> tuple[str, ...]:
        """One letter per winch."""
        return tuple(chr(ord("a") + i) for i in range(len(self.anchors)))

    def step_functions(self) -> tuple[StepFunction, ...]:
        """Return the cables' functions."""
        return tuple(StepFunction("winch", params=anchor) for anchor in self.anchors)

    def inverse(self, point: Point) -> tuple[float, ...]:
        """Return the cables' lengths."""
        return tuple(math.dist(anchor, point) for anchor in self.anchors)

    def forward(self, positions: tuple[float, ...]) -> Point:
        """Return the head's place; ValueError when the cables do not meet."""
        a, b, c = self.anchors[:MIN_WINCHES]
        index = self._off_plane()
        if index is None:
            return spheres_meet((a, b, c), (positions[0], positions[1], positions[2]))[0]
        others = ((1, subtract(b, a)), (2, subtract(c, a)), (index, subtract(self.anchors[index], a)))
        u, v, w = (_plane(positions[0], positions[i], to) for i, to in others)
        return along(a, (1.0, solve((others[0][1], others[1][1], others[2][1]), (u, v, w))))

    def _off_plane(self) -> int | None:
        """Return the number of an anchor that is not in the plane of the first three."""
        a, b, c, *others = self.anchors
        normal = cross(subtract(b, a), subtract(c, a))
        for index, anchor in enumerate(others, MIN_WINCHES):
            to = subtract(anchor, a)
            if abs(dot(normal, to)) > _FLAT * math.sqrt(dot(normal, normal) * dot(to, to)):
                return index
        return None

    @property
    def work_space(self) -> WorkSpace:
        """The box around all anchors; under anchors in one plane, the box down from there to the bed (Z 0).

        It then ends a little below them: cables that lie flat would have to pull with infinite force.
        """
        x, y, z = (tuple(anchor[axis] for anchor in self.anchors) for axis in range(3))
        low, high = min(z), max(z)
        if self._off_plane() is None:
            low, high = min(low, 0.0), low - _CLEARANCE * max(max(x) - min(x), max(y) - min(y))
        return WorkSpace((min(x), min(y), low), (max(x), max(y), high))


def _plane(first: float, length: float, anchor: Point) -> float:
    """Return anchor·p for points p at distance FIRST from the origin and LENGTH from ANCHOR."""
    return (first * first - length * length + dot(anchor, anchor)) / 2
