"""The demo's proof of a stepper fails where anything is not as planned."""

from typing import Any

import numpy as np
import pytest

from coordinator.motion.trapezoid_array import TRAPEZOID
from coordinator.runtime.timebase import ClockMap, ClockPiece
from coordinator.verification.expected import expected_steps
from coordinator.verification.proof import PrimaryClock, StepperProof, prove_stepper

FREQ = 1e6
STEP_MM = 0.01


def microseconds(clock: np.ndarray) -> np.ndarray:
    """Return the host's times of a node whose clock is the host's, in µs."""
    return clock.astype(np.int64) * 1000


def there_and_back() -> np.ndarray:
    """Return two trapezoids: 2 mm along X in 0.3 s, and back."""
    moves = np.zeros(2, TRAPEZOID)
    for move, begin, start, way in zip(moves, (1.0, 1.3), (0.0, 2.0), (1.0, -1.0), strict=True):
        move["print_time"], move["start"][0], move["ratio"][0] = begin, start, way
        move["accel_s"] = move["cruise_s"] = move["decel_s"] = 0.1
        move["cruise_v"], move["accel"] = 10.0, 100.0
    return moves


def proof_of(clock: Any, direction: Any, *, counted: int = 0) -> StepperProof:
    return prove_stepper(
        "stepper_x",
        "mcu",
        expected_steps(there_and_back(), (1, 0, 0, 0), STEP_MM, 0.0),
        [(clock, direction)],
        counted=counted,
        clock_map=ClockMap(FREQ, ClockPiece(0.0, 0.0, FREQ)),
        truth=microseconds,
        primary=PrimaryClock(monotonic_ns=0, ticks=0, true_ticks_per_s=FREQ, clock_freq=FREQ),
    )


@pytest.fixture(name="executed")
def _executed() -> tuple[Any, Any]:
    """What a node does that is right to the tick."""
    (steps,) = expected_steps(there_and_back(), (1, 0, 0, 0), STEP_MM, 0.0)
    return np.round(steps.print_time * FREQ).astype(np.uint64), steps.direction


def test_what_is_right_is_proved(executed: tuple[Any, Any]) -> None:
    proof = proof_of(*executed)
    assert proof.holds
    assert proof.steps_executed == 400
    assert proof.worst_band_error_s < 1e-6


def test_a_lost_step_is_found(executed: tuple[Any, Any]) -> None:
    clock, direction = executed
    for lost in range(len(clock)):
        proof = proof_of(np.delete(clock, lost), np.delete(direction, lost))
        assert not proof.holds
        assert (proof.steps_executed, proof.position_error_steps) == (399, 1)


def test_two_lost_steps_that_cancel_out_are_found(executed: tuple[Any, Any]) -> None:
    clock, direction = executed
    proof = proof_of(np.delete(clock, [3, 396]), np.delete(direction, [3, 396]))
    assert proof.position_error_steps == 0
    assert not proof.holds


@pytest.mark.parametrize("shift_us", [-100, 26, 100])
def test_a_step_at_another_time_is_found(executed: tuple[Any, Any], shift_us: int) -> None:
    clock, direction = executed
    for shifted in range(0, len(clock), 21):
        late = clock.copy()
        late[shifted] = int(late[shifted]) + shift_us
        proof = proof_of(late, direction)
        assert not proof.holds
        assert proof.worst_band_error_s == pytest.approx(abs(shift_us) * 1e-6, abs=1e-6)
        assert proof.worst_error_s == pytest.approx(abs(shift_us) * 1e-6, abs=1e-6)


def test_a_reversed_step_is_found(executed: tuple[Any, Any]) -> None:
    clock, direction = executed
    wrong = direction.copy()
    wrong[17] *= -1
    proof = proof_of(clock, wrong)
    assert not proof.holds
    assert (proof.wrong_directions, proof.position_error_steps) == (1, 2)


def test_two_steps_in_exchanged_directions_are_found(executed: tuple[Any, Any]) -> None:
    clock, direction = executed
    wrong = direction.copy()
    wrong[[10, 390]] = wrong[[390, 10]]
    proof = proof_of(clock, wrong)
    assert proof.position_error_steps == 0
    assert proof.wrong_directions == 2
    assert not proof.holds


def test_a_step_too_many_is_found(executed: tuple[Any, Any]) -> None:
    clock, direction = executed
    proof = proof_of(np.append(clock, clock[-1] + 50), np.append(direction, direction[-1:]))
    assert not proof.holds
    assert proof.steps_executed == 401


def test_a_node_that_counts_otherwise_is_found(executed: tuple[Any, Any]) -> None:
    assert not proof_of(*executed, counted=1).holds


def test_no_step_at_all_is_found() -> None:
    assert not proof_of(np.empty(0, np.uint64), np.empty(0, np.int8)).holds
