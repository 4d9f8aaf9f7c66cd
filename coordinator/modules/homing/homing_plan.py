"""What G28 does: which motors go towards which endstops, in what order, and where that leaves the head.

==================  =========================================================================================
an axis             all motors that move it; with endstops of further steppers each side stops at its own
towers, arms        all go up together, each until its own endstop; an arm's way is that of its elbow
the arm of a polar  alone, whatever the bed's angle is, which is 0 from then on
machine
second carriage     alone, behind the first one
==================  =========================================================================================
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final

from coordinator.config.model import MachineDescription, RailDescription
from coordinator.kinematics.base import Point

WAY_SHARE: Final = 1.5
"""An endstop has to switch within so many lengths of its axis."""
WAY_MAX_MM: Final = 150_000.0
"""And within this, of an axis that has no end: a belt."""
AXES: Final = ("x", "y", "z")


@dataclass(frozen=True, slots=True)
class Approach:
    """What one move brings home."""

    rails: "tuple[RailDescription, ...]"
    """Each of them stops at its own endstop."""
    letters: str
    """Axes whose place is known then."""
    axis: str
    """Whose limits hold."""
    ways: Mapping[str, float]
    """By stepper: how far it goes per mm towards the endstops; mm, or rad."""
    most_mm: float
    """Within which the endstops have to switch."""
    is_second_carriage: bool = False

    @property
    def possible(self) -> bool:
        """Whether there is an endstop for each."""
        return all(rail.homing.endstop_pin is not None for rail in self.rails)


def approaches(described: "MachineDescription") -> list[Approach]:
    """Return them in order."""
    rails = {rail.axis: rail for rail in described.rails}
    found = []
    for names in described.kinematics.homing_order:
        group = [rails[name] for name in names]
        letters = described.kinematics.homed_letters(names)
        if len(letters) == len(AXES):
            found.append(_together(described, group))
        elif len(letters) > 1:
            found.append(_alone(group[0], letters, letters[0].lower()))
        else:
            found.append(_axis(described, group[0]))
            if (second := _second(described, names[0])) is not None:
                found.append(second)
    return found


def _axis(described: "MachineDescription", rail: "RailDescription") -> Approach:
    space, at = described.kinematics.work_space, AXES.index(rail.axis)
    towards = _direction(rail)
    ways = {motor.name: towards * motor.weights[at] for motor in described.motors if motor.weights[at]}
    most_mm = min(WAY_SHARE * (space.high[at] - space.low[at]), WAY_MAX_MM)
    return Approach(rail.pieces, rail.axis.upper(), rail.axis, ways, most_mm)


def _together(described: "MachineDescription", rails: "Sequence[RailDescription]") -> Approach:
    space = described.kinematics.work_space
    ways, longest_mm = {}, space.high[2] - space.low[2]
    for rail in rails:
        for stepper in rail.steppers:
            ways[stepper.name] = 1.0
            if arm_mm := stepper.function.lever_mm:
                ways[stepper.name] = 1.0 / arm_mm
                longest_mm = max(longest_mm, math.pi * arm_mm)
    return Approach(tuple(rails), "XYZ", "z", ways, WAY_SHARE * longest_mm)


def _alone(rail: "RailDescription", letters: str, axis: str) -> Approach:
    assert rail.position_min is not None
    assert rail.position_max is not None
    ways = {stepper.name: float(_direction(rail)) for stepper in rail.steppers}
    most_mm = min(WAY_SHARE * (rail.position_max - rail.position_min), WAY_MAX_MM)
    return Approach((rail,), letters, axis, ways, most_mm)


def _second(described: "MachineDescription", axis: str) -> Approach | None:
    """Return how the second carriage is homed, if there is one on AXIS and it has an endstop."""
    rail, dual = described.second_carriage, described.dual_carriage
    if dual is None or AXES[dual.carriages.axis] != axis:
        return None
    assert rail is not None
    if rail.homing.endstop_pin is None:
        return None
    found = _alone(rail, axis.upper(), axis)
    weights = dict(dual.carriages.carriages[1].steppers)
    ways = {name: _direction(rail) * weight[dual.carriages.axis] for name, weight in weights.items()}
    return replace(found, ways=ways, is_second_carriage=True)


def _direction(rail: "RailDescription") -> int:
    return 1 if rail.homing.positive_dir else -1


def landed(
    described: "MachineDescription",
    approach: Approach,
    beyond_mm: Sequence[float],
    place: Point,
    y_of_towers: float,
) -> Point:
    """Return where the head is when the rails stand BEYOND_MM their endstops, PLACE being where it was.

    Y_OF_TOWERS: where the rail of Y is, on a machine whose towers do not move it.
    """
    x, y, z = place
    rail = approach.rails[0]
    if len(approach.letters) == len(AXES):
        return _head_of_towers(described, approach, beyond_mm, y_of_towers)
    assert rail.homing.position_endstop is not None
    at = rail.homing.position_endstop + _direction(rail) * beyond_mm[0]
    if approach.letters == "XY":  # an arm, which counts as along X
        return (at, 0.0, z)
    return (at if rail.axis == "x" else x, at if rail.axis == "y" else y, at if rail.axis == "z" else z)


def second_landed(approach: Approach, beyond_mm: Sequence[float]) -> float:
    """Return where the second carriage is, on its axis."""
    rail = approach.rails[0]
    assert rail.homing.position_endstop is not None
    return rail.homing.position_endstop + _direction(rail) * beyond_mm[0]


def _head_of_towers(
    described: "MachineDescription", approach: Approach, beyond_mm: Sequence[float], y: float
) -> Point:
    kinematics = described.kinematics
    places = [
        end + beyond * approach.ways[rail.steppers[0].name]
        for end, beyond, rail in zip(kinematics.endstop_positions, beyond_mm, approach.rails, strict=True)
    ]
    return kinematics.forward((*places, *(() if len(places) == len(kinematics.rails) else (y,))))
