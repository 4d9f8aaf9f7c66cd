"""Where a stepper stands whose axes rest at a position, in steps: the rule that step generation follows."""

import math

from coordinator.motion.planner.planner import Position
from coordinator.motion.specs import StepperSpec
from coordinator.motion.steps._steps import lib


def resting_step(spec: StepperSpec, start: Position, position: Position) -> int:
    """Return the steps a stepper that started at START has done when its axes rest at POSITION (mm).

    POSITION must not be at a half step: there it depends on where the stepper came from.
    """
    (step,) = resting_steps(spec, start, position)
    return step


def resting_steps(spec: StepperSpec, start: Position, position: Position) -> set[int]:
    """Return where the stepper may stand: at one step, or at a half step at either side of it."""
    begin, end = (_mix(spec, at) / spec.step_distance for at in (start, position))
    tie = 1 / int(lib.STEP_TIE)
    return {math.floor(end - begin + 0.5 - tie), math.floor(end - begin + 0.5 + tie)}


def _mix(spec: StepperSpec, position: Position) -> float:
    x, y, z, e = (weight * axis for weight, axis in zip(spec.weights, position, strict=True))
    return x + y + z + e
