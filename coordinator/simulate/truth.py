"""From the pins of simulated boards and the record of the plan to what the checker compares."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from coordinator.config.model import StepperDescription
from coordinator.simulate.checker import ExecutedSteps, concatenate
from coordinator.streaming.pipeline import PlanRecord
from coordinator.verification.expected import ExpectedSteps, Ints, expected_steps
from coordinator.verification.planned import epochs
from nodes.virtual.edge_log import steps_of


@dataclass(frozen=True, slots=True)
class BoardTruth:
    """All changes of a simulated board's outputs, oldest first; none was reported by the code under test."""

    at_ns: Ints
    """True time."""
    pin: NDArray[np.uint16]
    level: NDArray[np.uint8]
    life: NDArray[np.uint32]
    """How often the board had restarted."""


def executed(
    board: BoardTruth,
    stepper: StepperDescription,
    pins: Mapping[str, int],
    *,
    both_edges: bool,
    since_ns: int,
) -> ExecutedSteps:
    """Return the steps that STEPPER's pins on BOARD made after SINCE_NS of true time.

    PINS are the numbers of the board's pins; BOTH_EDGES: every change of the step pin is a step.
    """
    step_pin, dir_pin = pins[stepper.step_pin.name], pins[stepper.dir_pin.name]
    own = (board.pin == step_pin) | (board.pin == dir_pin)
    at_ns, pin, level = board.at_ns[own], board.pin[own], board.level[own]
    if not len(pin):
        return ExecutedSteps(np.empty(0, np.int64), np.empty(0, np.int8))
    idle = int(stepper.step_pin.invert)
    # True time goes through the pairing in place of the clock; it is not negative.
    chunks = [(at_ns.view(np.uint64), pin, level)]
    parts = list(steps_of(chunks, step_pin, both_edges=both_edges, step_idle_level=idle))
    times, ways = np.concatenate([t for t, _ in parts]).view(np.int64), np.concatenate([d for _, d in parts])
    wanted = (times > since_ns) & ~np.isin(times, _restarts(board))
    sign = np.int8(-1 if stepper.dir_pin.invert else 1)
    return ExecutedSteps(times[wanted], (ways[wanted] * sign).astype(np.int8))


def _restarts(board: BoardTruth) -> Ints:
    """Return when pins fell because the board restarted: that is no step. Its own first step comes later."""
    first = np.flatnonzero(np.diff(board.life)) + 1
    falls: Ints = board.at_ns[first[board.level[first] == 0]]
    return falls


def planned(record: PlanRecord, stepper: StepperDescription) -> ExpectedSteps:
    """Return the steps that the planned moves ask of STEPPER."""
    chunks: list[ExpectedSteps] = []
    for position, moves in epochs(record):
        origin = float(np.dot(stepper.weights, position))
        chunks += expected_steps(moves, stepper.weights, stepper.step_distance, origin)
    return concatenate(chunks)
