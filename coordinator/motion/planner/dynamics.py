"""What programs and the machine set of how fast, how hard and how far the moves to come may go."""

from collections.abc import Mapping
from typing import Any, Final

from coordinator.motion.planner._planner import lib
from coordinator.motion.planner.language import gcode_words
from coordinator.motion.planner.values import check_limits, check_number
from coordinator.motion.specs import MotionLimits

MAX_ADVANCE_S: Final = 10.0
EXTRUDER_LIMITS: Final = (
    "max_extrude_only_velocity",
    "max_extrude_only_accel",
    "max_extrude_only_distance",
    "max_extrude_ratio",
    "instantaneous_corner_velocity",
)


class Dynamics:
    """The part of ``Planner`` that is about limits; CORE is its struct planner. Speeds in mm/s."""

    def __init__(self, limits: MotionLimits, core: Any) -> None:
        self.limits = limits
        """What was configured; ``accel`` and the like below never exceed it."""
        self._core = core

    @property
    def accel(self) -> float:
        """mm/s² (M204)."""
        return float(self._core.accel)

    @accel.setter
    def accel(self, accel: float) -> None:
        self.set_accel_words({"S": accel})

    def set_accel_words(self, words: Mapping[str, float]) -> None:
        """M204: S, or the lower of P (print) and T (travel); one of these alone has no effect."""
        most = self.limits.max_accel
        capped = {key: min(check_number("the acceleration", a, 1e-3), most) for key, a in words.items()}
        if lib.gcode_accel(self._core, gcode_words(capped)):
            raise ValueError("M204 names no acceleration; give S, or P and T (mm/s²)")

    @property
    def max_velocity(self) -> float:
        """mm/s along the path."""
        return float(self._core.limits.max_velocity)

    @max_velocity.setter
    def max_velocity(self, velocity: float) -> None:
        velocity = check_number("the velocity", velocity, 1e-3)
        self._core.limits.max_velocity = min(velocity, self.limits.max_velocity)

    @property
    def square_corner_velocity(self) -> float:
        """mm/s."""
        return float(self._core.limits.square_corner_velocity)

    @square_corner_velocity.setter
    def square_corner_velocity(self, velocity: float) -> None:
        velocity = check_number("the square corner velocity", velocity, 0)
        self._core.limits.square_corner_velocity = min(velocity, self.limits.square_corner_velocity)

    @property
    def minimum_cruise_ratio(self) -> float:
        """0 <= ratio < 1."""
        return float(self._core.limits.minimum_cruise_ratio)

    @minimum_cruise_ratio.setter
    def minimum_cruise_ratio(self, ratio: float) -> None:
        self._core.limits.minimum_cruise_ratio = check_number("the minimum cruise ratio", ratio, 0, 0.999)

    @property
    def pressure_advance(self) -> float:
        """Seconds, of the printing moves to come."""
        return float(self._core.pressure_advance)

    @pressure_advance.setter
    def pressure_advance(self, advance_s: float) -> None:
        self._core.pressure_advance = check_number("the pressure advance", advance_s, 0, MAX_ADVANCE_S)

    # ---- Where and how the moves to come may go when the machine changes ----

    def set_range(self, axis: int, low: float, high: float) -> None:
        """AXIS (0 to 2) may go from LOW to HIGH, mm; nowhere when LOW is above HIGH."""
        self._core.limits.position_min[axis] = check_number("position_min", low, -1e6, 1e9)
        self._core.limits.position_max[axis] = check_number("position_max", high, -1e6, 1e9)

    def limit_axes(self, what: str, values: Mapping[str, float]) -> None:
        """Let X, Y, Z and filament alone (E) have at most VALUES of WHAT: ``velocity`` or ``accel``; mm, s.

        Never more than is configured; raises ValueError.
        """
        for letter, asked in values.items():
            name = f"max_extrude_only_{what}" if letter == "E" else f"max_{letter.lower()}_{what}"
            most = getattr(self.limits, name) or getattr(self.limits, f"max_{what}")
            setattr(self._core.limits, name, min(check_number(name, asked, 1e-3), most))

    @property
    def cold(self) -> bool:
        """Whether moves of filament are refused."""
        return bool(self._core.cold)

    @cold.setter
    def cold(self, cold: bool) -> None:
        self._core.cold = cold

    def set_extruder_limits(self, limits: MotionLimits) -> None:
        """Take over what LIMITS say of filament: another extruder is active."""
        check_limits(limits)
        for name in EXTRUDER_LIMITS:
            setattr(self._core.limits, name, getattr(limits, name))
