"""Rotary delta: three motors around the Z axis turn upper arms; lower arms carry the head from their elbows.

In the upright plane of an arm that stands in direction φ, with the head at (x', z) in this plane and y'
beside it, the shoulder at (R, H) and the elbow at (R + U·cos θ, H + U·sin θ), θ counted upwards from the
horizontal, the lower arm of length L demands

    (R + U·cos θ - x')² + (H + U·sin θ - z)² + y'² = L²

With a = R - x', b = H - z this is a·cos θ + b·sin θ = k, k = (L² - y'² - U² - a² - b²) / 2U, and so θ =
atan2(b, a) ± acos(k / √(a² + b²)); the elbow stands outwards with the minus. Forward: the head is where the
spheres of radius L around the elbows meet. Source: derived here from the closure of the two links; the
robot is R. Clavel's (US patent 4976582).

Step generation takes the formula rotary_delta (rotary_delta.c) with params (U, L, R, H, cos φ, sin φ).
"""

import math
from dataclasses import dataclass

from coordinator.kinematics.base import Kinematics, Point, StepFunction, WorkSpace
from coordinator.kinematics.geometry import spheres_meet

MIN_LEVERAGE = 1 / 3
"""Smallest share of the lower arm that is in the elbow's direction: an elbow is at most three times as fast
as the head, and the arms stay away from being stretched, where they would need to be infinitely fast."""
_DIRECTIONS = 24
_HALVINGS = 30
_RADII = 50


@dataclass(frozen=True, slots=True)
class Arm:
    """One arm."""

    upper_length: float
    lower_length: float
    angle: float
    """Direction in which it stands, rad from X towards Y."""


@dataclass(frozen=True, slots=True)
class RotaryDelta(Kinematics):
    """A rotary delta."""

    arms: tuple[Arm, Arm, Arm]
    shoulder_radius: float
    """Of the shoulders' circle less that of the joints at the head."""
    shoulder_height: float
    """Of the shoulders above the bed less that of the joints above the nozzle."""
    endstop_height: tuple[float, float, float]
    """Z of the head in the middle when each arm's endstop switches."""
    min_z: float = 0.0
    print_radius: float | None = None
    """None: what gives the largest cylinder."""
    name = "rotary_delta"
    rails = ("a", "b", "c")
    homing_order = (("a", "b", "c"),)

    def step_functions(self) -> tuple[StepFunction, ...]:
        """Return the arms' functions."""
        return tuple(
            StepFunction(
                "rotary_delta",
                turns=True,
                lever_mm=arm.upper_length,
                params=(
                    arm.upper_length,
                    arm.lower_length,
                    self.shoulder_radius,
                    self.shoulder_height,
                    math.cos(arm.angle),
                    math.sin(arm.angle),
                ),
            )
            for arm in self.arms
        )

    def inverse(self, point: Point) -> tuple[float, ...]:
        """Return the angles of the upper arms, rad; ValueError where an arm is too short."""
        return tuple(self.arm_angle(arm, point) for arm in self.arms)

    def arm_angle(self, arm: Arm, point: Point) -> float:
        """Return one upper arm's angle, rad above the horizontal; ValueError where the arm is too short."""
        outward, lateral = _turned(point, arm.angle)
        a, b = self.shoulder_radius - outward, self.shoulder_height - point[2]
        reach2 = a * a + b * b
        k = (arm.lower_length**2 - lateral**2 - arm.upper_length**2 - reach2) / (2 * arm.upper_length)
        if k * k > reach2:
            raise ValueError("an arm is too short or too long for this point")
        return math.atan2(b, a) - math.acos(k / math.sqrt(reach2))

    def forward(self, positions: tuple[float, ...]) -> Point:
        """Return the head's place for the arms' angles; ValueError when the lower arms do not meet."""
        a, b, c = (self._elbow(arm, angle) for arm, angle in zip(self.arms, positions, strict=True))
        lengths = (self.arms[0].lower_length, self.arms[1].lower_length, self.arms[2].lower_length)
        return spheres_meet((a, b, c), lengths)[0]

    def _elbow(self, arm: Arm, angle: float) -> Point:
        outward = self.shoulder_radius + arm.upper_length * math.cos(angle)
        return (
            outward * math.cos(arm.angle),
            outward * math.sin(arm.angle),
            self.shoulder_height + arm.upper_length * math.sin(angle),
        )

    @property
    def endstop_positions(self) -> tuple[float, ...]:
        """Where the endstops switch, rad."""
        return tuple(
            self.arm_angle(arm, (0.0, 0.0, z)) for arm, z in zip(self.arms, self.endstop_height, strict=True)
        )

    @property
    def widest_radius(self) -> float:
        """How far from the middle the head may be; 0 where the arms do not reach the bed."""
        low, high = 0.0, self.shoulder_height
        for _ in range(_HALVINGS):
            middle = (low + high) / 2
            low, high = (middle, high) if self._reaches(middle) else (low, middle)
        return low

    @property
    def work_space(self) -> WorkSpace:
        """The cylinder in which no endstop is overrun and no arm nearly stretched."""
        radius = self._roomiest_radius() if self.print_radius is None else self.print_radius
        slope = self._cone_slope()
        low, high = (-radius, -radius, self.min_z), (radius, radius, self._top(radius))
        cone_top = min(self.endstop_height)
        return WorkSpace(low, high, max_radius=radius, cone_slope=(slope, slope), cone_top=cone_top)

    def _cone_slope(self) -> float:
        """Return how steep the way down from the endstops must be so that no arm rises; see delta.py."""
        slopes = []
        for arm, angle in zip(self.arms, self.endstop_positions, strict=True):
            outward = self.shoulder_radius + arm.upper_length * math.cos(max(0.0, -angle))
            slopes.append(outward / math.sqrt(max(arm.lower_length**2 - outward**2, 1e-6)))
        return max(slopes)

    def _roomiest_radius(self) -> float:
        """Return the radius of the cylinder with the largest volume: a wide one is low."""
        widest = self.widest_radius
        radii = (widest * i / _RADII for i in range(1, _RADII + 1))
        return max(radii, key=lambda radius: radius * radius * (self._top(radius) - self.min_z))

    def _top(self, radius: float) -> float:
        """Return how high the head may be within RADIUS of the middle.

        At a given height an arm is highest when the head is straight below its elbow, or as near to that as
        the radius lets it.
        """
        tops = []
        for arm, angle in zip(self.arms, self.endstop_positions, strict=True):
            elbow = self.shoulder_radius + arm.upper_length * math.cos(angle)
            drop = math.sqrt(arm.lower_length**2 - max(elbow - radius, 0.0) ** 2)
            tops.append(self.shoulder_height + arm.upper_length * math.sin(angle) - drop)
        return min(tops)

    def _reaches(self, radius: float) -> bool:
        """Return whether the arms stay away from being stretched on the rims of the cylinder."""
        top = self._top(radius)
        return top >= self.min_z and all(
            self._leverage(arm, (radius * math.cos(direction), radius * math.sin(direction), z))
            >= MIN_LEVERAGE
            for arm in self.arms
            for direction in (arm.angle + i * math.tau / _DIRECTIONS for i in range(_DIRECTIONS))
            for z in (self.min_z, top)
        )

    def _leverage(self, arm: Arm, point: Point) -> float:
        """Return the share of the lower arm that is in the direction of the elbow's motion; 0: no reach."""
        try:
            angle = self.arm_angle(arm, point)
        except ValueError:
            return 0.0
        outward = _turned(point, arm.angle)[0] - self.shoulder_radius - arm.upper_length * math.cos(angle)
        up = point[2] - self.shoulder_height - arm.upper_length * math.sin(angle)
        return (outward * math.sin(angle) - up * math.cos(angle)) / arm.lower_length


def _turned(point: Point, angle: float) -> tuple[float, float]:
    """Return X and Y of POINT in axes turned by ANGLE."""
    cos, sin = math.cos(angle), math.sin(angle)
    return (point[0] * cos + point[1] * sin, point[1] * cos - point[0] * sin)
