"""Compares what a stepper was made to do (replay.py) with what it had to do (exact.py), step by step."""

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from coordinator.verification.exact_path import Leg, Position, StepperPath, follow, solve
from coordinator.verification.exact_signal import Floats
from coordinator.verification.half_steps import TIE_STEPS
from tests.coordinator.motion.replay import Stream

CHUNK = 1 << 18
NOISE_S = 2e-9
"""Print times of an hour have a resolution of 0.5 ns."""
NOISE_STEPS = 1e-7
"""Rounding of a position; where a stepper stands still, its crossing has no better defined time."""
Epoch = tuple[Position, NDArray[np.void]]
"""Where the axes are declared to stand, and the trapezoids from there on."""


@dataclass
class Verdict:
    """What the comparison of one stepper found."""

    name: str
    checked: int = 0
    """Steps whose time was compared."""
    worst_s: float = 0.0
    worst_share: float = 0.0
    """Largest error as a share of what the step was allowed."""
    outside: int = 0
    """Steps further off than allowed, or without a crossing at all."""
    outside_s: float = math.nan
    """Print time of the first of them."""
    emitted: int = 0
    wanted: int = 0
    """Steps that the motion asks for, those counted that were left out in pairs."""
    position: int = 0
    wanted_position: int = 0


class StepperProof:
    """One stepper's paths: one for each stretch between two declarations of the position."""

    def __init__(self, legs: Sequence[Leg]) -> None:
        self.name = legs[0].spec.name
        self.paths: list[StepperPath] = []
        self._begins: list[float] = []
        end = -math.inf
        self.wanted = self.wanted_position = 0
        for leg, (path, _, _, place) in zip(legs, follow(legs), strict=True):
            begin, last = float(leg.moves[0]["print_time"]), leg.moves[-1]
            self._begins.append((begin + end) / 2 if self.paths else -math.inf)
            end = float(last["print_time"] + last["accel_s"] + last["cruise_s"] + last["decel_s"])
            self.paths.append(path)
            self.wanted += int(np.abs(np.diff(place)).sum())
            self.wanted_position = int(place[-1])

    def true_times(
        self, boundary: Floats, direction: NDArray[np.int64], near: Floats, reach_s: float
    ) -> Floats:
        """Return when each boundary is crossed, within REACH_S of NEAR; NaN where it is not."""
        which = np.searchsorted(self._begins, near, side="right") - 1
        times = np.empty(len(near))
        for i in np.unique(which):
            mine = which == i
            times[mine] = solve(self.paths[i], boundary[mine], direction[mine], near[mine], reach_s)
        return times

    def ahead(self, boundary: Floats, direction: NDArray[np.int64], t: Floats) -> Floats:
        """Return by how many steps the stepper is beyond each boundary at T."""
        which = np.searchsorted(self._begins, t, side="right") - 1
        u = np.empty(len(t))
        for i in np.unique(which):
            mine = which == i
            u[mine] = self.paths[i].u(t[mine], boundary[mine])
        return direction * (u - boundary)


def check(
    proof: StepperProof,
    stream: Stream,
    freq: float,
    max_error_s: float,
    windows: Iterable[tuple[float, float]] | None = None,
) -> Verdict:
    """Compare every step of STREAM, or those inside WINDOWS (print times), with its true time."""
    verdict = Verdict(
        proof.name,
        emitted=stream.steps,
        wanted=proof.wanted,
        position=stream.end_position,
        wanted_position=proof.wanted_position,
    )
    if windows is None:
        _check_run(proof, stream.chunks(CHUNK), freq, max_error_s, verdict, whole=True)
        return verdict
    for begin, end in windows:
        first = int(np.searchsorted(stream.finish, begin * freq))
        last = int(np.searchsorted(stream.first, end * freq))
        _check_run(proof, stream.between(first, last).chunks(CHUNK), freq, max_error_s, verdict, whole=False)
    return verdict


def _check_run(
    proof: StepperProof,
    chunks: Iterator[Stream],
    freq: float,
    max_error_s: float,
    verdict: Verdict,
    *,
    whole: bool,
) -> None:
    """Compare the steps of CHUNKS, which follow each other. WHOLE: nothing comes before or behind."""
    # [emitted, true, boundary, direction] of the last step that is compared and of the one that waits for
    # its successor's time.
    held = np.array([[-math.inf, -math.inf, 0.0, 1.0]]) if whole else np.empty((0, 4))
    for chunk in chunks:
        clock, direction, position = chunk.expand()
        emitted = clock / freq
        boundary = position + direction / 2
        true = proof.true_times(boundary, direction, emitted, max_error_s + NOISE_S)
        held = np.concatenate((held, np.stack((emitted, true, boundary, direction), axis=1)))
        _compare(proof, held, max_error_s, verdict)
        held = held[-2:]
    if whole:
        _compare(proof, np.concatenate((held, [[math.inf, math.inf, 0.0, 1.0]])), max_error_s, verdict)


def _compare(proof: StepperProof, rows: NDArray[np.float64], max_error_s: float, verdict: Verdict) -> None:
    """Judge all rows but the first and the last."""
    emitted, true, boundary, direction = rows[1:-1].T
    if not len(emitted):
        return
    times = np.where(np.isnan(rows[:, 1]), rows[:, 0], rows[:, 1])
    gap = np.diff(times)
    allowed = np.minimum(max_error_s, np.minimum(gap[:-1], gap[1:]) / 2)
    error = np.abs(emitted - true)
    bad = np.flatnonzero(~(error <= allowed + NOISE_S))
    if len(bad):
        # Perhaps it stands still on the boundary: then its place decides, not its time.
        sign = direction[bad].astype(np.int64)
        before = proof.ahead(boundary[bad], sign, emitted[bad] - allowed[bad] - NOISE_S)
        behind = proof.ahead(boundary[bad], sign, emitted[bad] + allowed[bad] + NOISE_S)
        room = np.where(np.isnan(true[bad]), TIE_STEPS, 0.0) + NOISE_STEPS
        excused = (before <= room) & (behind >= -room)
        error[bad[excused]] = 0.0
        bad = bad[~excused]
    verdict.checked += len(emitted)
    verdict.outside += len(bad)
    if len(bad) and math.isnan(verdict.outside_s):
        verdict.outside_s = float(emitted[bad[0]])
    good = np.setdiff1d(np.arange(len(emitted)), bad, assume_unique=True)
    if len(good):
        verdict.worst_s = max(verdict.worst_s, float(error[good].max()))
        verdict.worst_share = max(verdict.worst_share, float((error[good] / allowed[good]).max()))
