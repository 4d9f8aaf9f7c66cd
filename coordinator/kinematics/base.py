"""What every kinematics offers. Lengths in mm, angles in rad; a point is X Y Z of the head.

A *rail* is what one motor, or several side by side, move: an axis, a tower, an arm, a winch. Its position is
what step generation divides by the way per step: mm, or rad where the rail turns.
"""

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

Point = tuple[float, float, float]
Weights = tuple[float, float, float, float]

NO_WEIGHTS: Weights = (0.0, 0.0, 0.0, 0.0)
FILAMENT: Weights = (0.0, 0.0, 0.0, 1.0)
"""Of a stepper that moves the filament."""


@dataclass(frozen=True, slots=True)
class StepFunction:
    """How step generation gets a rail's position from the axes: a sum of them, or a formula in C."""

    formula: str | None = None
    """Name given to STEP_FORMULA in coordinator/kinematics/*.c; None: the sum of WEIGHTS times axes."""
    weights: Weights = NO_WEIGHTS
    """Of X Y Z E, where there is no formula."""
    params: tuple[float, ...] = ()
    """Of the formula, at most 8."""
    axes: str = "xyz"
    """Of a formula: the axes that move the rail."""
    turns: bool = False
    """Whether the position is an angle, rad."""
    lever_mm: float = 0.0
    """Of an angle: length of the arm that turns; 0: no arm."""

    @property
    def linear(self) -> bool:
        """Whether the position is a sum of the axes."""
        return self.formula is None


def linear(x: float = 0.0, y: float = 0.0, z: float = 0.0) -> StepFunction:
    """Return a rail whose position is a sum of the axes."""
    return StepFunction(weights=(x, y, z, 0.0))


@dataclass(frozen=True, slots=True)
class WorkSpace:
    """Where the head may be: a box, of which a cylinder around Z may be all that counts, and a cone above.

    Each is convex, so that a straight move between two points of the same one stays within; but for the hole.
    """

    low: Point
    high: Point
    max_radius: float = 0.0
    """Largest distance from the Z axis; 0: the box alone counts."""
    radius_min: float = 0.0
    """Smallest distance from the Z axis: a hole."""
    cone_slope: tuple[float, float] = (0.0, 0.0)
    """Slopes 0: no cone. Else the head may also be above the box, where homing leaves it, in the cone
    z + √((sx·x)² + (sy·y)²) <= cone_top."""
    cone_top: float = 0.0
    tower_radius: float = 0.0
    """Of a delta: how far level its rods reach with the head in the middle."""
    tower_rod: float = 0.0
    """Of a delta: length of its shortest rod, which lies flatter the further the head is out. 0: no delta."""


class Kinematics(ABC):
    """Between the head and its rails. Subclasses are frozen values without any state."""

    __slots__ = ()
    name: ClassVar[str]
    """As in the configuration."""
    second_carriages: ClassVar[Mapping[str, StepFunction]] = {}
    """By axis that may have a second carriage ([dual_carriage]): how that one's motor follows the axes."""
    even_along_z: ClassVar[bool] = False
    """Whether a rail that is no sum of axes, but that Z moves, goes as far as the head does along Z."""

    @property
    @abstractmethod
    def rails(self) -> tuple[str, ...]:
        """Names of the rails, in the order in which positions are given and taken."""

    @property
    @abstractmethod
    def homing_order(self) -> tuple[tuple[str, ...], ...]:
        """Rails that are homed one after the other; those of one group move together."""

    @property
    @abstractmethod
    def work_space(self) -> WorkSpace:
        """Where the head may be."""

    @property
    def endstop_positions(self) -> tuple[float, ...]:
        """Where the endstops of towers or arms are that all go up together when homed; empty: no such."""
        return ()

    @property
    def homes_upwards(self) -> bool:
        """Whether homing moves the head up, away from what is on the bed."""
        return bool(self.endstop_positions)

    @property
    def straight(self) -> bool:
        """Whether rails are sums of the axes.

        Then the head may be moved before it is known where it is, and homing X and Y keeps Z.
        """
        return bool(self.rails) and all(function.linear for function in self.step_functions())

    def homed_letters(self, group: tuple[str, ...]) -> str:
        """Return the axes whose position is known when a group of ``homing_order`` is homed."""
        return "XYZ" if len(group) > 1 else group[0].upper()

    @abstractmethod
    def step_functions(self) -> tuple[StepFunction, ...]:
        """Return what step generation computes for each rail."""

    def with_motors(self, motors: "tuple[tuple[str, Point], ...]") -> "Kinematics":  # noqa: ARG002
        """Return the machine whose MOTORS (by name) are these sums of X Y Z: itself where they are fixed."""
        return self

    @abstractmethod
    def inverse(self, point: Point) -> tuple[float, ...]:
        """Return the rails' positions with the head at POINT; ValueError where it cannot be."""

    @abstractmethod
    def forward(self, positions: tuple[float, ...]) -> Point:
        """Return where the head is when the rails are at POSITIONS; ValueError where they cannot be."""
