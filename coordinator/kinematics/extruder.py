"""Which steppers move the filament: the active extruder's, and those that are synchronised to its motion.

There is one E axis, which is the active extruder's. A stepper follows the motion of one extruder or of
none: its position is E while that extruder is active, and stands still otherwise (weight 1 or 0 of E).
Source: the definition.

Everything here is a value; a change happens at standstill and gives a new ``ExtruderMotion``.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace

from coordinator.kinematics.base import FILAMENT, NO_WEIGHTS, Weights


@dataclass(frozen=True, slots=True)
class ExtruderMotion:
    """Who follows whom."""

    extruders: tuple[str, ...]
    active: str
    """Name of an extruder; empty on a machine without any."""
    followed: Mapping[str, str]
    """By stepper (an extruder's own has its name): the extruder whose motion it follows; empty: none."""

    def activate(self, extruder: str) -> "ExtruderMotion":
        """Return the state after the extruder was chosen; ValueError when there is none of this name."""
        self._check(extruder)
        return replace(self, active=extruder)

    def sync(self, stepper: str, extruder: str) -> "ExtruderMotion":
        """Return the state after STEPPER was synchronised to the motion of EXTRUDER (empty: of none)."""
        if stepper not in self.followed:
            known = ", ".join(self.followed)
            raise ValueError(f"there is no extruder stepper '{stepper}'; there is {known or 'none'}")
        if extruder:
            self._check(extruder)
        return replace(self, followed={**self.followed, stepper: extruder})

    def weights(self) -> dict[str, Weights]:
        """Return the weights of all filament steppers."""
        active = self.active
        return {
            name: FILAMENT if active and to == active else NO_WEIGHTS for name, to in self.followed.items()
        }

    def _check(self, extruder: str) -> None:
        if extruder not in self.extruders:
            known = ", ".join(self.extruders)
            raise ValueError(f"there is no extruder '{extruder}'; there is {known or 'none'}")
