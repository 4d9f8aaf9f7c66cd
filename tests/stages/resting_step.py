"""Where a stepper stands whose axes rest at a position, in steps: the rule that step generation follows."""

import math

from coordinator.motion.planner.planner import Position
from coordinator.motion.specs import StepperSpec
from coordinator.motion.steps._steps import lib


def resting_step(spec: StepperSpec, start: Position, position: Position) -> int:
    """Return the steps a stepper that started at START has done when its axes rest at POSITION (mm).

    Half a step rounds up, and 1/65536 of a step decides no tie.
    """
    begin, end = (_mix(spec, at) / spec.step_distance for at in (start, position))
    snap = int(lib.STEP_SNAP)
    return math.floor(round((end - begin) * snap) / snap + 0.5)


def _mix(spec: StepperSpec, position: Position) -> float:
    x, y, z, e = (weight * axis for weight, axis in zip(spec.weights, position, strict=True))
    return x + y + z + e
