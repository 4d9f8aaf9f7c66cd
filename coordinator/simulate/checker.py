"""The checker compares the changes of the nodes' pins with the plan, independently of the code under test.

Expected steps come from numpy over the planner's trapezoids (`coordinator.verification.expected`),
executed ones from the pins of the simulated boards with the simulation's true time. Neither the step
generator, nor links, nor clock estimates take part. Steps are paired in order, so one that is doubled, lost
or reversed shows as a difference in number, direction or time.
"""

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from coordinator.verification.expected import ExpectedSteps, Floats, Ints

STEP_BAND_S: Final = 12.5e-6
"""Maximum deviation of a step from its planned time by step generation."""
ROUNDING_TICKS: Final = 2
"""Rounding of a step's time: one tick for the interval, one for the clock of the pin."""

PrintTime = Callable[[Ints], Floats]
"""From true time in ns to print time in s."""


@dataclass(frozen=True, slots=True)
class Violation:
    """A rule that was violated."""

    rule: str
    """In one word, for statistics."""
    text: str
    """What was violated, where, and by how much."""


@dataclass(frozen=True, slots=True)
class ExecutedSteps:
    """What a stepper's pins did: true times in ns, directions +1 or -1 as motion counts them."""

    at_ns: Ints
    direction: NDArray[np.int8]


@dataclass(frozen=True, slots=True, kw_only=True)
class StepperTruth:
    """The planned and the executed steps of one stepper."""

    stepper: str
    node: str
    planned: ExpectedSteps
    executed: ExecutedSteps
    allowed_s: float
    """Maximum deviation of a step from its planned time."""
    counted: int | None = None
    """Steps by the node's own counter, if it could be queried."""
    reachable: bool = True
    """Whether a stop could reach its node when it was declared."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Ending:
    """How the run ended, in true time."""

    cause: str | None = None
    """The sentence of the stop; None: the job completed."""
    stopped_ns: int | None = None
    """When it was declared."""
    complete_until_ns: int = 0
    """Up to here no step may be missing, stop or not."""
    stop_s: float = 0.1
    """How long after a stop a node that could be reached may go on."""


@dataclass(frozen=True, slots=True, kw_only=True)
class OutputTruth:
    """An output of no stepper, and the changes of its pin."""

    name: str
    node: str
    at_ns: Ints
    """True times of its changes."""
    level: NDArray[np.uint8]
    """The new levels."""
    stopped: int
    """The level that it has to have after a stop."""
    reachable: bool
    """Whether a stop could reach its node when it was declared."""
    cold_ns: Sequence[tuple[int, int]] = ()
    """Intervals within which it must be off."""

    def level_at(self, at_ns: int) -> int:
        """Return the level at AT_NS."""
        before = int(np.searchsorted(self.at_ns, at_ns, side="right"))
        return int(self.level[before - 1]) if before else 0


@dataclass(frozen=True, slots=True)
class QueueDepth:
    """The maximum depth of a queue."""

    name: str
    deepest: int
    bound: int


def concatenate(chunks: Sequence[ExpectedSteps]) -> ExpectedSteps:
    """Return all steps of CHUNKS as one."""
    if not chunks:
        return ExpectedSteps(np.empty(0), np.empty(0, np.int8))
    return ExpectedSteps(
        np.concatenate([c.print_time for c in chunks]), np.concatenate([c.direction for c in chunks])
    )


def check_stepper(truth: StepperTruth, print_time: PrintTime, ending: Ending) -> list[Violation]:
    """Return the violations of one stepper."""
    found: list[Violation] = []
    where = f"{truth.stepper} on node {truth.node}"

    def wrong(rule: str, text: str) -> None:
        found.append(Violation(rule, f"{where}: {text}"))

    planned, executed = truth.planned, truth.executed
    at_s = print_time(executed.at_ns)
    count = min(len(at_s), len(planned.print_time))
    if (back := np.flatnonzero(np.diff(executed.at_ns) <= 0)).size:
        wrong("order", f"step {back[0] + 1} comes before the one ahead of it, at {at_s[back[0] + 1]:.6f} s")
    if len(at_s) > count:
        wrong(
            "unplanned", f"{len(at_s) - count} steps beyond the {count} planned, first at {at_s[count]:.6f} s"
        )
    _check_missing(truth, print_time, ending, wrong)
    turned = np.flatnonzero(executed.direction[:count] != planned.direction[:count])
    if turned.size:
        n = turned[0]
        wrong(
            "direction",
            f"step {n} at {at_s[n]:.6f} s goes {executed.direction[n]:+d}, planned {planned.direction[n]:+d}"
            f"; {turned.size} such steps",
        )
    off_s = at_s[:count] - planned.print_time[:count]
    outside = np.flatnonzero(np.abs(off_s) > truth.allowed_s)
    if outside.size:
        n, worst = outside[0], outside[np.argmax(np.abs(off_s[outside]))]
        wrong(
            "band",
            f"step {n} of {count}, planned for {planned.print_time[n]:.6f} s, is {off_s[n] * 1e6:+.1f} µs off"
            f" (allowed {truth.allowed_s * 1e6:.1f}); {outside.size} such steps, worst"
            f" {off_s[worst] * 1e6:+.1f} µs",
        )
    _check_counter(truth, ending, wrong)
    return found


Wrong = Callable[[str, str], None]


def _check_missing(truth: StepperTruth, print_time: PrintTime, ending: Ending, wrong: Wrong) -> None:
    due, done = truth.planned.print_time, len(truth.executed.at_ns)
    missing = len(due) - done
    if missing > 0:
        until = np.inf
        if ending.cause is not None:
            until = float(print_time(np.array([ending.complete_until_ns]))[0]) - truth.allowed_s
        lacking = int(np.count_nonzero(due[done:] < until))
        if lacking:
            wrong("missing", f"{lacking} of {len(due)} steps are missing, first that for {due[done]:.6f} s")
    if ending.stopped_ns is not None and truth.reachable:
        limit = ending.stopped_ns + round(ending.stop_s * 1e9)
        after = int(np.count_nonzero(truth.executed.at_ns > limit))
        if after:
            late_s = (int(truth.executed.at_ns[-1]) - ending.stopped_ns) * 1e-9
            wrong(
                "after-stop",
                f"{after} steps more than {ending.stop_s} s after the stop, up to {late_s:.3f} s",
            )


def _check_counter(truth: StepperTruth, ending: Ending, wrong: Wrong) -> None:
    if truth.counted is None:
        return
    stands = int(truth.executed.direction.sum(dtype=np.int64))
    if truth.counted != stands:
        wrong("counter", f"the node counts {truth.counted:+d} steps, its pins made {stands:+d}")
    planned = int(truth.planned.direction.sum(dtype=np.int64))
    if ending.cause is None and truth.counted != planned:
        wrong("counter", f"the node counts {truth.counted:+d} steps, planned were {planned:+d}")


def check_output(truth: OutputTruth, ending: Ending) -> list[Violation]:
    """Return the violations of one output."""
    found = []
    where = f"{truth.name} on node {truth.node}"
    for begin_ns, end_ns in truth.cold_ns:
        if truth.level_at(begin_ns) or ((truth.at_ns > begin_ns) & (truth.at_ns < end_ns)).any():
            found.append(
                Violation(
                    "heat", f"{where} is on {(end_ns - begin_ns) * 1e-9:.3f} s before its sensor is sound"
                )
            )
    if ending.stopped_ns is not None and truth.reachable:
        limit_ns = ending.stopped_ns + round(ending.stop_s * 1e9)
        level, later = truth.level_at(limit_ns), int(np.count_nonzero(truth.at_ns > limit_ns))
        if level != truth.stopped or later:
            found.append(
                Violation(
                    "output",
                    f"{where} has level {level} {ending.stop_s} s after the stop and {later} changes later;"
                    f" it has to keep {truth.stopped}",
                )
            )
    return found


def check_queues(depths: Sequence[QueueDepth]) -> list[Violation]:
    """Return the queues that exceeded their bounds."""
    return [
        Violation("queue", f"{q.name} held {q.deepest}, its bound is {q.bound}")
        for q in depths
        if q.deepest > q.bound
    ]


MAX_CAUSE_CHARS: Final = 500


def check_ending(expect: str, causes: Sequence[str], ending: Ending) -> list[Violation]:
    """Return the violations of the end of the run: every stop must have an expected cause."""
    cause = ending.cause
    if cause is None:
        return [Violation("ending", "the job completed, but it had to stop")] if expect == "stops" else []
    found = []
    if expect == "completes":
        found.append(Violation("ending", f"the job had to complete, but it stopped: {cause}"))
    elif not any(re.search(pattern, cause) for pattern in causes):
        expected = "' or '".join(causes)
        found.append(Violation("cause", f"it stopped because '{cause}'; expected is '{expected}'"))
    if not cause.strip() or "Traceback" in cause or "\n" in cause or len(cause) > MAX_CAUSE_CHARS:
        found.append(Violation("sentence", f"the cause is not one clear sentence: {cause!r}"))
    return found


def worst_error_s(truth: StepperTruth, print_time: PrintTime) -> float:
    """Return the maximum deviation of a step from its planned time."""
    at_s = print_time(truth.executed.at_ns)
    count = min(len(at_s), len(truth.planned.print_time))
    return float(np.abs(at_s[:count] - truth.planned.print_time[:count]).max()) if count else 0.0
