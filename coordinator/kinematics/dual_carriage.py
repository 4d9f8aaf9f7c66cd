"""Two carriages on one axis (IDEX): which moves with the head, which follows, and how far both may go.

One carriage is the primary: it is where the head is, and the axis' position is its own. The other is
parked, copies the primary (it moves by the same way) or mirrors it (it moves by the opposite way). With p₀
and p₁ the carriages' positions when the mode was set, the other stands at

    inactive: p₁        copy: p₁ + (p - p₀)        mirror: p₁ - (p - p₀)

so a stepper of the other carriage has the weight 0, 1 or -1 of this axis where the primary's has 1, times
what it has on a machine with this carriage alone. Other axes' weights stay: a belt that the gantry carries
along moves in any mode. Source: the definition of the modes.

Everything here is a value; a change of mode happens at standstill and gives a new ``CarriageState``.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import Enum
from typing import Final

from coordinator.kinematics.base import Weights

_ROUNDING_MM: Final = 1e-6


class CarriageMode(Enum):
    """What a carriage does; the value is its word in SET_DUAL_CARRIAGE."""

    PRIMARY = "PRIMARY"
    COPY = "COPY"
    MIRROR = "MIRROR"
    INACTIVE = "INACTIVE"


SCALES = {CarriageMode.PRIMARY: 1, CarriageMode.COPY: 1, CarriageMode.MIRROR: -1, CarriageMode.INACTIVE: 0}


@dataclass(frozen=True, slots=True)
class Carriage:
    """One of the two."""

    low: float
    """mm, as the axis counts."""
    high: float
    home: float
    """Where it is after homing."""
    steppers: tuple[tuple[str, Weights], ...]
    """Names, and weights when this carriage is the primary."""
    name: str = ""
    """As status reports call it."""


@dataclass(frozen=True, slots=True)
class CarriageState:
    """What both carriages do."""

    modes: tuple[CarriageMode, CarriageMode]
    positions: tuple[float, float]
    """mm; of both carriages where the mode was set."""

    @property
    def primary(self) -> int:
        """Number of the carriage that is the head."""
        return self.modes.index(CarriageMode.PRIMARY)

    @property
    def position(self) -> float:
        """Where the axis stood when the mode was set."""
        return self.positions[self.primary]

    def at(self, position: float) -> tuple[float, float]:
        """Return where both carriages are when the axis is at POSITION."""
        way = position - self.position
        one, two = (p + SCALES[mode] * way for p, mode in zip(self.positions, self.modes, strict=True))
        return one, two


@dataclass(frozen=True, slots=True)
class DualCarriage:
    """Both carriages of an axis."""

    axis: int
    """0: X, 1: Y."""
    carriages: tuple[Carriage, Carriage]
    safe_distance: float
    """mm that the carriages keep between their positions; 0: they pass each other."""
    home_speed_mm_s: float = 50.0
    """At which the axis is homed."""

    @property
    def home(self) -> CarriageState:
        """The state after homing: the first carriage is the head."""
        return CarriageState(
            (CarriageMode.PRIMARY, CarriageMode.INACTIVE), (self.carriages[0].home, self.carriages[1].home)
        )

    def set_mode(
        self, state: CarriageState, position: float, carriage: int, mode: CarriageMode
    ) -> CarriageState:
        """Return the state after CARRIAGE (0 or 1) takes MODE with the axis at POSITION.

        PRIMARY parks the other one, which stays where it is. ValueError says why the mode cannot be.
        """
        here = CarriageState(state.modes, state.at(position))
        if mode is CarriageMode.PRIMARY:
            modes = [CarriageMode.INACTIVE, CarriageMode.INACTIVE]
            modes[carriage] = mode
        elif carriage == state.primary:
            raise ValueError(
                f"carriage {carriage} is the primary and cannot be {mode.value}; make carriage"
                f" {1 - carriage} PRIMARY first"
            )
        else:
            modes = list(state.modes)
            modes[carriage] = mode
        after = replace(here, modes=(modes[0], modes[1]))
        low, high = self.limits(after)
        if mode in {CarriageMode.COPY, CarriageMode.MIRROR} and not low <= after.position <= high:
            raise ValueError(
                f"carriage {carriage} cannot be {mode.value} from where the carriages are"
                f" ({after.positions[0]:.6g} and {after.positions[1]:.6g} mm); move them apart first"
            )
        return after

    def limits(self, state: CarriageState) -> tuple[float, float]:
        """Return how far the axis may go so that both carriages stay in their ranges, safely apart."""
        primary = state.primary
        me, other = self.carriages[primary], self.carriages[1 - primary]
        at, other_at = state.positions[primary], state.positions[1 - primary]
        low, high = me.low, me.high
        match state.modes[1 - primary]:
            case CarriageMode.COPY:
                low, high = max(low, at + other.low - other_at), min(high, at + other.high - other_at)
                if abs(other_at - at) < self.safe_distance:
                    low, high = at + 1.0, at - 1.0  # nowhere: they would move too close to each other
            case CarriageMode.MIRROR:
                low, high = max(low, at + other_at - other.high), min(high, at + other_at - other.low)
                low, high = self._apart(low, high, at < other_at, (at + other_at) / 2, self.safe_distance / 2)
            case _:
                low, high = self._apart(low, high, at < other_at, other_at, self.safe_distance)
        return low, high

    def order_of_moves(self, here: tuple[float, float], targets: tuple[float, float]) -> tuple[int, ...]:
        """Return which carriages have to move from HERE to TARGETS, in an order that keeps them apart.

        ValueError where there is none.
        """
        moving = [i for i in (0, 1) if abs(here[i] - targets[i]) > 1e-9]
        for order in (moving, moving[::-1]):
            if self._stay_apart(here, targets, order):
                return tuple(order)
        raise ValueError(
            f"the carriages cannot go back to {targets[0]:.6g} and {targets[1]:.6g} mm one after the other"
            " and stay apart; move them there by G1"
        )

    def _stay_apart(
        self, here: tuple[float, float], targets: tuple[float, float], order: Sequence[int]
    ) -> bool:
        """Whether each of ORDER may go to its target while the other stands."""
        at = list(here)
        for carriage in order:
            modes = [CarriageMode.INACTIVE, CarriageMode.INACTIVE]
            modes[carriage] = CarriageMode.PRIMARY
            low, high = self.limits(CarriageState((modes[0], modes[1]), (at[0], at[1])))
            if not low - _ROUNDING_MM <= targets[carriage] <= high + _ROUNDING_MM:
                return False
            at[carriage] = targets[carriage]
        return True

    def _apart(
        self,
        low: float,
        high: float,
        below: bool,
        middle: float,
        distance: float,
    ) -> tuple[float, float]:
        """Keep a range that much below (or above) MIDDLE; a safe distance of 0 keeps nothing."""
        if not self.safe_distance:
            return low, high
        return (low, min(high, middle - distance)) if below else (max(low, middle + distance), high)

    def weights(self, state: CarriageState) -> dict[str, Weights]:
        """Return the weights of all steppers of both carriages."""
        result = {}
        for carriage, mode in zip(self.carriages, state.modes, strict=True):
            for name, weights in carriage.steppers:
                scaled = [w * SCALES[mode] if i == self.axis else w for i, w in enumerate(weights)]
                result[name] = (scaled[0], scaled[1], scaled[2], scaled[3])
        return result
