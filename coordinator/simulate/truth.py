"""From the pins of simulated boards and the record of the plan to what the checker compares."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from coordinator.demo.expected import ExpectedSteps, Ints, expected_steps
from coordinator.machine.description import StepperDescription
from coordinator.pipeline import PlanRecord
from coordinator.simulate.checker import ExecutedSteps, concatenate
from nodes.virtual.edge_log import steps_of

_PIN_MASK: Final = np.uint64(0x7FFF)
_ONE: Final = np.uint64(1)
_CLOCK_SHIFT: Final = np.uint64(16)

Clocks = NDArray[np.uint64]


@dataclass(frozen=True, slots=True)
class BoardTruth:
    """What a simulated board did: nothing in here was told by the code under test."""

    edges: Clocks
    """All changes of outputs: clock << 16 | pin << 1 | level, oldest first."""
    true_ns: Callable[[Clocks], Ints]
    """True times at which the board's clock (48 bits) read these."""
    resets_ns: Sequence[int] = ()
    """When it restarted: then all pins fall at once, which is no step."""


def executed(
    board: BoardTruth,
    stepper: StepperDescription,
    pins: dict[str, int],
    *,
    both_edges: bool,
    since_ns: int,
) -> ExecutedSteps:
    """Return the steps that STEPPER's pins on BOARD made after SINCE_NS of true time.

    PINS are the numbers of the board's pins; BOTH_EDGES: every change of the step pin is a step.
    """
    step_pin, dir_pin = pins[stepper.step_pin.name], pins[stepper.dir_pin.name]
    pin = ((board.edges >> _ONE) & _PIN_MASK).astype(np.uint16)
    own = (pin == step_pin) | (pin == dir_pin)
    records, pin = board.edges[own], pin[own]
    clock = records >> _CLOCK_SHIFT
    at_ns = board.true_ns(clock)
    level = (records & _ONE).astype(np.uint8)
    # Clock and true time go through the pairing together: the time stands in for the clock.
    chunks = [(at_ns.view(np.uint64), pin, level)]
    idle = int(stepper.step_pin.invert)
    parts = list(steps_of(chunks, step_pin, both_edges=both_edges, step_idle_level=idle)) if len(pin) else []
    times = np.concatenate([t for t, _ in parts]).view(np.int64) if parts else np.empty(0, np.int64)
    ways = np.concatenate([d for _, d in parts]) if parts else np.empty(0, np.int8)
    wanted = times > since_ns
    for reset_ns in board.resets_ns:
        wanted &= times != reset_ns
    sign = np.int8(-1 if stepper.dir_pin.invert else 1)
    return ExecutedSteps(times[wanted], (ways[wanted] * sign).astype(np.int8))


def planned(record: PlanRecord, stepper: StepperDescription) -> ExpectedSteps:
    """Return the steps that the planned moves ask of STEPPER."""
    chunks: list[ExpectedSteps] = []
    for position, moves in record.epochs():
        origin = float(np.dot(stepper.weights, position))
        chunks += expected_steps(moves, stepper.weights, stepper.step_distance, origin)
    return concatenate(chunks)
