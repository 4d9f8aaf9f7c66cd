"""The record of a plan as proofs read it: numpy arrays of trapezoids, cut where positions were declared."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from coordinator.motion.planner.planner import Position
from coordinator.motion.trapezoid_array import TRAPEZOID
from coordinator.runtime.timebase import ClockMap
from coordinator.streaming.pipeline import MotionSettings, PlanRecord

Moves = NDArray[np.void]
"""Of dtype TRAPEZOID."""


@dataclass(frozen=True, slots=True)
class Segment:
    """Consecutive trapezoids with one position declaration and one set of settings."""

    start: Position
    """Where the axes stand at its begin."""
    declared: bool
    """Whether they were declared to stand there; else they came there, and every stepper goes on as it is."""
    moves: Moves
    settings: MotionSettings


def epochs(record: PlanRecord) -> list[tuple[Position, Moves]]:
    """Return the segments of RECORD between declarations: where each begins, and its trapezoids."""
    every = np.frombuffer(record.every(), TRAPEZOID)
    cuts = [(0, record.start), *record.declared]
    ends = [at for at, _ in cuts[1:]] + [len(every)]
    return [(position, every[at:end]) for (at, position), end in zip(cuts, ends, strict=True)]


def segments(record: PlanRecord) -> list[Segment]:
    """Return the segments of RECORD between declarations and changes, those with trapezoids, in order."""
    found: list[Segment] = []
    at, changes = 0, [*record.settings]
    settings = MotionSettings({}, {}, {})
    for position, moves in epochs(record):
        begin, epoch_end = at, at + len(moves)
        while at < epoch_end:
            while changes and changes[0][0] <= at:
                settings = changes.pop(0)[1]
            end = min([epoch_end, *(n for n, _ in changes[:1])])
            start = _four(moves[at - begin]["start"].tolist()) if at > begin else position
            found.append(Segment(start, at == begin, moves[at - begin : end - begin], settings))
            at = end
    return found


def _four(values: Sequence[float]) -> Position:
    x, y, z, e = values
    return (x, y, z, e)


def ticks_at(clock_map: ClockMap, print_time: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the node's ticks at these print times, none before the first piece of CLOCK_MAP."""
    pieces = [(piece.print_time, piece.ticks, piece.ticks_per_s) for piece in clock_map.pieces]
    begins, ticks, rates = np.array(pieces).T
    which = np.clip(np.searchsorted(begins, print_time, side="right") - 1, 0, None)
    mapped: NDArray[np.float64] = ticks[which] + (print_time - begins[which]) * rates[which]
    return mapped
