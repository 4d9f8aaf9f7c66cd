"""Steps as pins make them: levels, directions, inversions, and what a reset does to pins."""

import dataclasses

import numpy as np
import pytest

from coordinator.assembly.load import load_machine
from coordinator.config.model import StepperDescription
from coordinator.simulate import scenario, truth
from coordinator.simulate.truth import BoardTruth

STEP, DIR, OTHER = 20, 21, 5
PINS = {"STEP": STEP, "DIR": DIR}


def stepper(*, invert_step: bool = False, invert_dir: bool = False) -> StepperDescription:
    described = load_machine(str(scenario.find("clean").machine)).steppers[0]
    return dataclasses.replace(
        described,
        step_pin=dataclasses.replace(described.step_pin, name="STEP", invert=invert_step),
        dir_pin=dataclasses.replace(described.dir_pin, name="DIR", invert=invert_dir),
    )


def board(*edges: tuple[int, int, int], restart_us: int = 1000) -> BoardTruth:
    """Return a board whose pins changed at (µs after the start, pin, level)."""
    at_us, pin, level = zip(*edges, strict=True) if edges else ((), (), ())
    return BoardTruth(
        at_ns=np.array(at_us, np.int64) * 1000,
        pin=np.array(pin, np.uint16),
        level=np.array(level, np.uint8),
        life=np.array([at >= restart_us for at in at_us], np.uint32),
    )


def steps(made: BoardTruth, described: StepperDescription, **how: bool) -> list[tuple[int, int]]:
    """Return (µs, direction) of the steps after 5 µs."""
    found = truth.executed(made, described, PINS, both_edges=how.get("both_edges", False), since_ns=5000)
    return [(int(t) // 1000, int(d)) for t, d in zip(found.at_ns, found.direction, strict=True)]


def test_a_step_is_a_rising_edge_in_the_direction_of_the_pin() -> None:
    made = board(
        *((10, DIR, 1), (20, STEP, 1), (22, STEP, 0), (25, OTHER, 1), (30, STEP, 1), (32, STEP, 0)),
        *((40, DIR, 0), (50, STEP, 1), (52, STEP, 0)),
    )
    assert steps(made, stepper()) == [(20, 1), (30, 1), (50, -1)]
    assert steps(made, stepper(invert_dir=True)) == [(20, -1), (30, -1), (50, 1)]


def test_an_inverted_step_pin_steps_when_it_falls() -> None:
    made = board((1, STEP, 1), (20, STEP, 0), (22, STEP, 1), (30, STEP, 0), (32, STEP, 1))
    assert steps(made, stepper(invert_step=True)) == [(20, -1), (30, -1)]


def test_both_edges_count_where_the_driver_takes_both() -> None:
    made = board((10, DIR, 1), (20, STEP, 1), (30, STEP, 0), (40, STEP, 1))
    assert steps(made, stepper(), both_edges=True) == [(20, 1), (30, 1), (40, 1)]


def test_pins_that_fall_at_a_reset_are_no_steps_but_later_ones_are() -> None:
    made = board((20, STEP, 1), (30, STEP, 0), (40, STEP, 1), restart_us=30)
    assert steps(made, stepper(), both_edges=True) == [(20, -1), (40, -1)]


def test_what_was_before_the_job_does_not_count() -> None:
    assert steps(board((2, STEP, 1), (3, STEP, 0), (10, STEP, 1)), stepper()) == [(10, -1)]


@pytest.mark.parametrize("edges", [(), ((10, OTHER, 1),)])
def test_a_board_that_never_stepped_has_no_steps(edges: tuple[tuple[int, int, int], ...]) -> None:
    assert steps(board(*edges), stepper()) == []
