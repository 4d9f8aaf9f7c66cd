"""Linear delta: carriages on three upright towers hold the head by rods of fixed length.

A tower stands at (tx, ty), its rod is A long. The carriage's height above the bed is u = z + √(A² - (tx -
x)² - (ty - y)²). Forward: the head is the lower of the two points where the spheres of radius A around the
joints (tx, ty, u) meet. Source: the Pythagorean theorem on the rod; the same in S. Graves, "Johann C.
Rocholl (Rostock) style delta robot kinematics" (2012).

``delta_radius`` is measured from a carriage's joint to the head's joint with the head in the middle, so
that the head counts as a point here. Step generation takes the formula delta (delta.c) with params (A², tx,
ty).
"""

import math
from dataclasses import dataclass

from coordinator.kinematics.base import Kinematics, Point, StepFunction, WorkSpace
from coordinator.kinematics.geometry import spheres_meet

MAX_TOWER_SPEED = 12.0
"""How much faster than the head a carriage would be where the head may not go.

It grows without bound as a rod lies down; from 3 times on the planner has the head go slower."""
_FLATTEST = math.sin(math.atan(MAX_TOWER_SPEED))
"""Share of a rod's length that is horizontal then: speed ratio = horizontal / vertical."""


@dataclass(frozen=True, slots=True)
class Tower:
    """One tower with its rod."""

    angle: float
    """Direction in which it stands, rad from X towards Y."""
    rod_length: float
    endstop_height: float
    """Z of the head in the middle when the carriage is at its endstop."""


@dataclass(frozen=True, slots=True)
class Delta(Kinematics):
    """A linear delta."""

    towers: tuple[Tower, Tower, Tower]
    radius: float
    """From the tower's joints to the head's, with the head in the middle."""
    min_z: float = 0.0
    print_radius: float | None = None
    """None: the radius, or less where a rod would lie too flat."""
    name = "delta"
    even_along_z = True
    rails = ("a", "b", "c")
    homing_order = (("a", "b", "c"),)

    def step_functions(self) -> tuple[StepFunction, ...]:
        """Return the towers' functions."""
        return tuple(
            StepFunction("delta", params=(tower.rod_length**2, *self._foot(tower))) for tower in self.towers
        )

    def inverse(self, point: Point) -> tuple[float, ...]:
        """Return the carriages' heights; ValueError where a rod is too short."""
        x, y, z = point
        heights = []
        for tower in self.towers:
            tx, ty = self._foot(tower)
            heights.append(z + math.sqrt(tower.rod_length**2 - (tx - x) ** 2 - (ty - y) ** 2))
        return tuple(heights)

    def forward(self, positions: tuple[float, ...]) -> Point:
        """Return the head's place for the carriages' heights; ValueError when the rods do not meet."""
        a, b, c = ((*self._foot(tower), u) for tower, u in zip(self.towers, positions, strict=True))
        lengths = (self.towers[0].rod_length, self.towers[1].rod_length, self.towers[2].rod_length)
        return spheres_meet((a, b, c), lengths)[0]

    def _foot(self, tower: Tower) -> tuple[float, float]:
        return self.radius * math.cos(tower.angle), self.radius * math.sin(tower.angle)

    @property
    def feet(self) -> tuple[tuple[float, float], ...]:
        """X and Y of the joints, by tower, mm."""
        return tuple(self._foot(tower) for tower in self.towers)

    @property
    def widest_radius(self) -> float:
        """How far from the middle the head may be before a rod lies too flat."""
        return self.shortest_rod * _FLATTEST - self.radius

    @property
    def shortest_rod(self) -> float:
        """Length, mm."""
        return min(tower.rod_length for tower in self.towers)

    @property
    def endstop_positions(self) -> tuple[float, ...]:
        """Where the carriages' endstops are."""
        return tuple(t.endstop_height + math.sqrt(t.rod_length**2 - self.radius**2) for t in self.towers)

    @property
    def work_space(self) -> WorkSpace:
        """The cylinder in which no carriage overruns its endstop.

        A carriage is highest with the head as near to its tower as the cylinder lets it. In the middle the
        head can be higher, up to where it is after homing. On the way down from there no carriage rises if
        the way is at least as steep as the carriages there are fast: R / √(A² - R²).
        """
        asked = self.radius if self.print_radius is None else self.print_radius
        radius = min(asked, self.widest_radius)
        nearest = max(self.radius - radius, 0.0)
        top = min(
            end - math.sqrt(tower.rod_length**2 - nearest**2)
            for tower, end in zip(self.towers, self.endstop_positions, strict=True)
        )
        slope = max(self.radius / math.sqrt(t.rod_length**2 - self.radius**2) for t in self.towers)
        low, high = (-radius, -radius, self.min_z), (radius, radius, top)
        cone_top = min(tower.endstop_height for tower in self.towers)
        return WorkSpace(
            low,
            high,
            max_radius=radius,
            cone_slope=(slope, slope),
            cone_top=cone_top,
            tower_radius=self.radius,
            tower_rod=self.shortest_rod,
        )
