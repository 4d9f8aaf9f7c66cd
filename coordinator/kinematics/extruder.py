"""Which steppers move the filament: the active extruder's, and those that are synchronised to its motion.

There is one E axis, which is the active extruder's. A stepper follows the motion of one extruder or of
none: its position is E while that extruder is active, and stands still otherwise (weight 1 or 0 of E).
A stepper that takes another way per turn than it is configured for has the weight configured / real: more
steps for a shorter way, the other direction for a negative one. Source: the definition.

Everything here is a value; a change happens at standstill and gives a new ``ExtruderMotion``.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

from coordinator.kinematics.base import NO_WEIGHTS, Weights


@dataclass(frozen=True, slots=True)
class ExtruderMotion:
    """Who follows whom."""

    extruders: tuple[str, ...]
    active: str
    """Name of an extruder; empty on a machine without any."""
    followed: Mapping[str, str]
    """By stepper (an extruder's own has its name): the extruder whose motion it follows; empty: none."""
    rotation_mm: Mapping[str, float] = field(default_factory=dict)
    """By stepper: the way of the filament for one turn, as it is configured."""
    changed_mm: Mapping[str, float] = field(default_factory=dict)
    """By stepper: the way for one turn that a program has set; below 0 it turns the other way round."""

    def activate(self, extruder: str) -> "ExtruderMotion":
        """Return the state after the extruder was chosen; ValueError when there is none of this name."""
        self._check(extruder)
        return replace(self, active=extruder)

    def sync(self, stepper: str, extruder: str) -> "ExtruderMotion":
        """Return the state after STEPPER was synchronised to the motion of EXTRUDER (empty: of none)."""
        self._check_stepper(stepper)
        if extruder:
            self._check(extruder)
        return replace(self, followed={**self.followed, stepper: extruder})

    def rotation_distance_mm(self, stepper: str) -> float:
        """Return the way of the filament for one turn of STEPPER; ValueError when there is none."""
        self._check_stepper(stepper)
        return self.changed_mm.get(stepper, self.rotation_mm.get(stepper, 1.0))

    def set_rotation_distance(self, stepper: str, distance_mm: float) -> "ExtruderMotion":
        """Return the state after STEPPER takes DISTANCE_MM per turn; ValueError when there is none."""
        self._check_stepper(stepper)
        return replace(self, changed_mm={**self.changed_mm, stepper: distance_mm})

    def weights(self) -> dict[str, Weights]:
        """Return the weights of all filament steppers."""
        active = self.active
        return {
            name: self._moving(name) if active and to == active else NO_WEIGHTS
            for name, to in self.followed.items()
        }

    def _moving(self, stepper: str) -> Weights:
        changed = self.changed_mm.get(stepper)
        e = 1.0 if changed is None else self.rotation_mm.get(stepper, 1.0) / changed
        return (0.0, 0.0, 0.0, e)

    def _check_stepper(self, stepper: str) -> None:
        if stepper not in self.followed:
            known = ", ".join(self.followed)
            raise ValueError(f"there is no extruder stepper '{stepper}'; there is {known or 'none'}")

    def _check(self, extruder: str) -> None:
        if extruder not in self.extruders:
            known = ", ".join(self.extruders)
            raise ValueError(f"there is no extruder '{extruder}'; there is {known or 'none'}")
