"""Where the head truly is at the end, as the plant knows it, against where the machine believes it to be.

What homing found decides: an endstop that was missed by a step shifts everything that follows.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from coordinator.config.model import MachineDescription
from coordinator.streaming.pipeline import PlanRecord
from coordinator.verification.planned import epochs
from nodes.virtual.plant import Axis
from nodes.virtual.plant_page import Motor

STEPS_OFF: Final = 2.0
"""Error of a homed axis in steps, at most: one for each of two roundings. After sensorless homing it counts
full steps: a motor follows its field no better."""


@dataclass(frozen=True, slots=True)
class PlaceProof:
    """One axis or tower that was homed."""

    axis: str
    believed_mm: float
    true_mm: float
    step_mm: float
    steps_off: float = STEPS_OFF
    """So many steps of it are allowed."""

    @property
    def error_mm(self) -> float:
        """Distance from the believed position."""
        return self.true_mm - self.believed_mm

    @property
    def holds(self) -> bool:
        """Whether rounding explains it: to steps, after sensorless homing to full steps."""
        return abs(self.error_mm) <= self.steps_off * self.step_mm


def prove_places(
    description: MachineDescription,
    plan: PlanRecord,
    axes: Mapping[str, Axis],
    motors: Mapping[str, Mapping[str, "Motor"]],
) -> list[PlaceProof]:
    """Compare every one of AXES that was homed; MOTORS: where they stand, by node and name.

    Empty where the program did not home.
    """
    if not plan.declared:
        return []
    head = _end_of(plan)[:3]
    believed = dict(zip("xyz", head, strict=True))
    heights = description.kinematics.inverse((head[0], head[1], head[2]))
    for rail in description.rails:
        if rail.axis not in believed and rail.axis in description.kinematics.rails:
            believed[rail.steppers[0].name] = heights[description.kinematics.rails.index(rail.axis)]
    return [
        PlaceProof(
            axis=name,
            believed_mm=believed[name],
            true_mm=axis.origin + sum(t.mm_per_step * motors[t.node][t.stepper].count for t in axis.terms),
            step_mm=sum(abs(term.mm_per_step) for term in axis.terms),
            steps_off=_steps_off(description, name),
        )
        for name, axis in axes.items()
        if name in believed
    ]


def _steps_off(description: MachineDescription, axis: str) -> float:
    """Return how many steps an axis may be off."""
    for rail in description.rails:
        if rail.axis == axis and rail.homing.virtual_endstop:
            return STEPS_OFF * rail.steppers[0].microsteps
    return STEPS_OFF


def _end_of(plan: PlanRecord) -> list[float]:
    position, moves = epochs(plan)[-1]
    if not len(moves):
        return [float(value) for value in position]
    last = moves[-1]
    ramp_up = last["start_v"] * last["accel_s"] + last["accel"] * last["accel_s"] ** 2 / 2
    ramp_down = last["cruise_v"] * last["decel_s"] - last["accel"] * last["decel_s"] ** 2 / 2
    way = ramp_up + last["cruise_v"] * last["cruise_s"] + ramp_down
    end: NDArray[np.float64] = last["start"] + last["ratio"] * way
    return [float(value) for value in end]
