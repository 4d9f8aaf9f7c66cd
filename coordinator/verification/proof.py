"""The proof: what every stepper's pins did, against an independent evaluation of the plan.

Executed steps come from the log of pin levels that each virtual node kept, with the node's true clock;
expected ones from numpy (`coordinator.verification.expected`). Steps are paired in order, so a lost, doubled
or reversed step shows as a difference in number, direction or time.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from coordinator.runtime.timebase import ClockMap
from coordinator.verification.expected import ExpectedSteps, Floats
from coordinator.verification.planned import ticks_at

EDGE_TOLERANCE_S = 25e-6
"""No step may be further than this from its planned time, clock error apart."""

Clocks = NDArray[np.uint64]
TrueTime = Callable[[Clocks], NDArray[np.int64]]
"""From clocks of a node, by its log, to times of the host's CLOCK_MONOTONIC in ns."""


@dataclass(frozen=True, slots=True)
class StepperProof:
    """What was found of one stepper."""

    stepper: str
    node: str
    steps_expected: int
    steps_executed: int
    position_expected: int
    position_executed: int
    position_counted: int
    """What the node itself counted."""
    wrong_directions: int
    worst_band_error_s: float
    """Furthest that a step's clock lay from the plan, by the clocks the host believed in."""
    worst_error_s: float
    """Furthest that a step lay from the plan in truth: includes the error of clock synchronisation."""

    @property
    def position_error_steps(self) -> int:
        """Steps between where the stepper stands and where the plan says."""
        return abs(self.position_executed - self.position_expected)

    @property
    def holds(self) -> bool:
        """Whether every step was where, when and which way it should have been."""
        return (
            self.steps_executed == self.steps_expected
            and self.position_error_steps == 0
            and self.position_counted == self.position_expected
            and self.wrong_directions == 0
            and self.worst_band_error_s <= EDGE_TOLERANCE_S
        )


class PrimaryClock:
    """Print time in truth: the primary node's own clock at its nominal frequency."""

    def __init__(self, *, monotonic_ns: int, ticks: int, true_ticks_per_s: float, clock_freq: float) -> None:
        self._monotonic_ns = monotonic_ns
        self._ticks = ticks
        self._true_ticks_per_s = true_ticks_per_s
        self._clock_freq = clock_freq

    def print_time(self, monotonic_ns: NDArray[np.int64]) -> Floats:
        """Return the print time at these moments of the host's clock."""
        elapsed_s = (monotonic_ns - self._monotonic_ns) * 1e-9
        ticks = self._ticks + elapsed_s * self._true_ticks_per_s
        return np.asarray(ticks / self._clock_freq, np.float64)


class _Buffered:
    """Executed steps handed out in the sizes asked for."""

    def __init__(self, chunks: Iterable[tuple[Clocks, NDArray[np.int8]]]) -> None:
        self._chunks: Iterator[tuple[Clocks, NDArray[np.int8]]] = iter(chunks)
        self._clock: Clocks = np.empty(0, np.uint64)
        self._direction: NDArray[np.int8] = np.empty(0, np.int8)

    def take(self, count: int) -> tuple[Clocks, NDArray[np.int8]]:
        """Return the next COUNT steps, or as many as there are."""
        clocks, directions = [self._clock], [self._direction]
        have = len(self._clock)
        while have < count:
            chunk = next(self._chunks, None)
            if chunk is None:
                break
            clocks.append(chunk[0])
            directions.append(chunk[1])
            have += len(chunk[0])
        clock, direction = np.concatenate(clocks), np.concatenate(directions)
        self._clock, self._direction = clock[count:], direction[count:]
        return clock[:count], direction[:count]

    def rest(self) -> tuple[int, int]:
        """Return the number of steps not yet taken, and their sum."""
        count, total = len(self._clock), int(self._direction.sum(dtype=np.int64))
        for clock, direction in self._chunks:
            count += len(clock)
            total += int(direction.sum(dtype=np.int64))
        return count, total


def prove_stepper(
    stepper: str,
    node: str,
    expected: Iterable[ExpectedSteps],
    executed: Iterable[tuple[Clocks, NDArray[np.int8]]],
    *,
    counted: int,
    clock_map: ClockMap,
    truth: TrueTime,
    primary: PrimaryClock,
) -> StepperProof:
    """Pair EXPECTED with EXECUTED steps (clock, direction) and measure every difference.

    COUNTED is where the node itself says that the stepper stands.
    """
    log = _Buffered(executed)
    steps_expected = steps_executed = position_expected = position_executed = wrong = 0
    worst_band = worst_true = 0.0
    for chunk in expected:
        steps_expected += len(chunk.print_time)
        position_expected += int(chunk.direction.sum(dtype=np.int64))
        clock, direction = log.take(len(chunk.print_time))
        if not len(clock):
            continue
        steps_executed += len(clock)
        position_executed += int(direction.sum(dtype=np.int64))
        planned = chunk.print_time[: len(clock)]
        wrong += int(np.count_nonzero(direction != chunk.direction[: len(clock)]))
        band = (clock.astype(np.float64) - ticks_at(clock_map, planned)) / clock_map.clock_freq
        worst_band = max(worst_band, float(np.abs(band).max()))
        true = primary.print_time(truth(clock)) - planned
        worst_true = max(worst_true, float(np.abs(true).max()))
    more, total = log.rest()
    return StepperProof(
        stepper=stepper,
        node=node,
        steps_expected=steps_expected,
        steps_executed=steps_executed + more,
        position_expected=position_expected,
        position_executed=position_executed + total,
        position_counted=counted,
        wrong_directions=wrong,
        worst_band_error_s=worst_band,
        worst_error_s=worst_true,
    )


@dataclass(frozen=True, slots=True)
class ClockProof:
    """How far a secondary node's clock was from print time, over the whole run."""

    node: str
    rms_s: float
    worst_s: float


def prove_clock(
    node: str,
    clock_map: ClockMap,
    truth: TrueTime,
    primary: PrimaryClock,
    span: Sequence[float],
) -> ClockProof:
    """Compare the map that the host used with the truth, every 10 ms of print time in SPAN (begin, end)."""
    moments = np.arange(span[0], span[1], 0.01)
    if not len(moments):
        return ClockProof(node, 0.0, 0.0)
    ticks = ticks_at(clock_map, moments)
    true = primary.print_time(truth(ticks.astype(np.uint64)))
    error = true - moments
    return ClockProof(node, float(np.sqrt(np.mean(error**2))), float(np.abs(error).max()))
