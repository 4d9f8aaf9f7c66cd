"""The checker catches what is planted, and nothing else."""

import dataclasses

import numpy as np
import pytest
from numpy.typing import NDArray

from coordinator.simulate import checker
from coordinator.simulate.checker import Ending, ExecutedSteps, QueueDepth, StepperTruth, Violation
from coordinator.verification.expected import ExpectedSteps

PRIMARY_PPM = 37.0
BEGIN_NS = 5_000_000_000
COUNT = 400


def print_time(at_ns: NDArray[np.int64]) -> NDArray[np.float64]:
    """A primary clock that runs fast and stood at 100 s when the simulation began."""
    return np.asarray(100.0 + at_ns * 1e-9 * (1 + PRIMARY_PPM * 1e-6))


def true_ns(print_time_s: NDArray[np.float64]) -> NDArray[np.int64]:
    return np.rint((print_time_s - 100.0) / (1 + PRIMARY_PPM * 1e-6) * 1e9).astype(np.int64)


def truth(noise_s: float = 12e-6) -> StepperTruth:
    """Steps there and back, each somewhere in the band."""
    rng = np.random.default_rng(3)
    at_s = 105.0 + np.cumsum(rng.uniform(50e-6, 4e-3, COUNT))
    direction = np.where(np.arange(COUNT) < COUNT // 4, 1, -1).astype(np.int8)
    executed = at_s + rng.uniform(-noise_s, noise_s, COUNT)
    return StepperTruth(
        stepper="stepper_x",
        node="mcu",
        planned=ExpectedSteps(at_s, direction),
        executed=ExecutedSteps(true_ns(executed), direction.copy()),
        allowed_s=12.6e-6,
        counted=int(direction.sum()),
    )


DONE = Ending()


def rules(found: list[Violation]) -> set[str]:
    return {violation.rule for violation in found}


def spoiled(at_ns: NDArray[np.int64], direction: NDArray[np.int8]) -> StepperTruth:
    return dataclasses.replace(truth(), executed=ExecutedSteps(at_ns, direction))


def test_sound_steps_pass() -> None:
    assert checker.check_stepper(truth(), print_time, DONE) == []


def test_every_step_counts() -> None:
    """Whichever one step is doubled, lost, late or reversed: it is found."""
    good = truth().executed
    for n in range(COUNT):
        at, way = good.at_ns, good.direction
        doubled = spoiled(np.insert(at, n, at[n]), np.insert(way, n, way[n]))
        assert {"order", "unplanned"} <= rules(checker.check_stepper(doubled, print_time, DONE))
        lost = spoiled(np.delete(at, n), np.delete(way, n))
        assert "missing" in rules(checker.check_stepper(lost, print_time, DONE))
        late = at.copy()
        late[n] += 30_000
        assert "band" in rules(checker.check_stepper(spoiled(late, way), print_time, DONE))
        turned = way.copy()
        turned[n] = -turned[n]
        found = checker.check_stepper(spoiled(at, turned), print_time, DONE)
        assert {"direction", "counter"} <= rules(found)


def test_a_doubled_step_a_moment_later_is_unplanned_and_out_of_its_band() -> None:
    good = truth().executed
    at = np.insert(good.at_ns, 101, good.at_ns[100] + 10_000)
    way = np.insert(good.direction, 101, good.direction[100])
    found = checker.check_stepper(spoiled(at, way), print_time, DONE)
    assert {"unplanned", "band", "counter"} <= rules(found)
    assert "step 101 of" in next(v.text for v in found if v.rule == "band")


def test_swapped_steps_are_out_of_order() -> None:
    at = truth().executed.at_ns.copy()
    at[[50, 51]] = at[[51, 50]]
    assert "order" in rules(checker.check_stepper(spoiled(at, truth().executed.direction), print_time, DONE))


def test_a_lost_and_a_doubled_step_do_not_make_up_for_each_other() -> None:
    good = truth().executed
    at = np.insert(np.delete(good.at_ns, 200), 300, good.at_ns[300] + 1000)
    way = np.insert(np.delete(good.direction, 200), 300, good.direction[300])
    assert "band" in rules(checker.check_stepper(spoiled(np.sort(at), way), print_time, DONE))


@pytest.mark.parametrize(("late_us", "caught"), [(-11, False), (11, False), (30, True), (-30, True)])
def test_the_band_is_as_wide_as_stated(late_us: float, caught: bool) -> None:
    whole = truth(noise_s=1e-6)
    moved = whole.executed.at_ns + round(late_us * 1000)
    found = checker.check_stepper(spoiled(moved, whole.executed.direction), print_time, DONE)
    assert rules(found) == ({"band"} if caught else set())


def test_a_wrong_position_counter_is_found() -> None:
    counted = dataclasses.replace(truth(), counted=truth().executed.direction.sum() + 1)
    found = checker.check_stepper(counted, print_time, DONE)
    assert rules(found) == {"counter"}


# ------------------------------------------------------------------------------------------ after a stop


def stopped(after_step: int, complete_until_step: int = 0) -> Ending:
    at = truth().executed.at_ns
    return Ending(
        cause="lost node mcu: gone",
        stopped_ns=int(at[after_step]),
        complete_until_ns=int(at[complete_until_step]),
        stop_s=0.01,
    )


def cut_off_at(step: int) -> StepperTruth:
    good = truth()
    executed = ExecutedSteps(good.executed.at_ns[:step], good.executed.direction[:step])
    return dataclasses.replace(good, executed=executed, counted=None)


def test_after_a_stop_the_rest_may_be_missing() -> None:
    assert checker.check_stepper(cut_off_at(200), print_time, stopped(199)) == []


def test_what_was_due_before_the_fault_may_not_be_missing() -> None:
    found = checker.check_stepper(cut_off_at(150), print_time, stopped(199, complete_until_step=180))
    assert rules(found) == {"missing"}
    assert found[0].text.startswith("stepper_x on node mcu: 3") or "29 of 400" in found[0].text


def test_a_step_after_the_stop_is_found() -> None:
    found = checker.check_stepper(truth(), print_time, stopped(200))
    assert rules(found) == {"after-stop"}


def test_a_node_out_of_reach_may_go_on_with_what_it_has() -> None:
    away = dataclasses.replace(truth(), reachable=False)
    assert checker.check_stepper(away, print_time, stopped(200)) == []


def test_after_a_stop_the_steps_before_it_still_have_to_be_right() -> None:
    part = cut_off_at(200)
    at = part.executed.at_ns.copy()
    at[77] += 40_000
    late = dataclasses.replace(part, executed=ExecutedSteps(at, part.executed.direction))
    assert rules(checker.check_stepper(late, print_time, stopped(199))) == {"band"}


def test_a_stepper_that_never_moved_is_right_when_nothing_was_planned() -> None:
    nothing = checker.concatenate([])
    idle = ExecutedSteps(np.empty(0, np.int64), np.empty(0, np.int8))
    still = dataclasses.replace(truth(), planned=nothing, executed=idle, counted=0)
    assert checker.check_stepper(still, print_time, DONE) == []
    assert checker.worst_error_s(still, print_time) == 0.0


# ---------------------------------------------------------------------------------------- queues, ending


def test_a_queue_beyond_its_bound_is_named() -> None:
    found = checker.check_queues([QueueDepth("a", 64, 64), QueueDepth("window of node mcu", 193, 192)])
    assert [v.text for v in found] == ["window of node mcu held 193, its bound is 192"]


@pytest.mark.parametrize(
    ("expect", "cause", "expected"),
    [
        ("completes", None, set()),
        ("completes", "lost node mcu: gone", {"ending"}),
        ("stops", None, {"ending"}),
        ("stops", "lost node mcu: gone", set()),
        ("stops", "node mcu shut down: Timer too close", {"cause"}),
        ("may_stop", None, set()),
        ("may_stop", "lost node mcu: gone", set()),
        ("may_stop", "lost node mcu: \nTraceback (most recent call last)", {"sentence"}),
        ("may_stop", "", {"sentence", "cause"}),
    ],
)
def test_every_stop_has_a_cause_that_is_to_be_expected(
    expect: str, cause: str | None, expected: set[str]
) -> None:
    found = checker.check_ending(expect, ("lost node mcu",), Ending(cause=cause))
    assert rules(found) == expected
