"""Exchanges with two nodes of known true clocks, recorded or generated; the score of an estimate.

Shared by the tests and by bench/clock.py. The score is the error of the secondary's clock when the primary is
what counts: at each moment, only what was received by then is used.
"""

import math
import random
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from nodes.clock.clock import ClockEstimate, ClockEstimator, HostTime, Ticks

SETTLED_S = 5.0
GOOD_S = 50e-6
STEP_S = 0.25


class Profile(NamedTuple):
    """Delays in one direction, in seconds: base + exponential; 1 % are later by up to OUTLIER_S."""

    base_s: float
    mean_s: float
    outlier_s: float
    goals_us: tuple[float, float, float]
    """Most rms error before, during and after the ramp."""

    def draw(self, rng: random.Random) -> float:
        late_s = rng.uniform(0.25, 1.0) * self.outlier_s if rng.random() < 0.01 else 0.0
        return self.base_s + rng.expovariate(1 / self.mean_s) + late_s


PROFILES = {
    "A": Profile(200e-6, 300e-6, 20e-3, (43.0, 19.0, 17.0)),
    "B": Profile(60e-6, 30e-6, 2e-3, (4.5, 7.6, 2.0)),
    "C": Profile(150e-6, 100e-6, 5e-3, (11.6, 9.6, 5.6)),
}


@dataclass(frozen=True)
class Truth:
    """A node's true clock: PPM off, and by RAMP_PPM more at the end of a ramp in its rate."""

    freq_hz: float
    ppm: float
    ramp_ppm: float
    c0: int
    ramp_start_s: float = 310.0
    ramp_s: float = 600.0

    def __call__(self, t: float) -> float:
        u = min(max(t - self.ramp_start_s, 0), self.ramp_s)
        v = max(t - self.ramp_start_s - self.ramp_s, 0)
        ramp = self.ramp_ppm * (u * u / (2 * self.ramp_s) + v)
        return self.c0 + self.freq_hz * (t + 1e-6 * (self.ppm * t + ramp))


@dataclass
class Trace:
    """Exchanges (sent ns, received ns, 64-bit clock) with a node, and its true clock."""

    truth: Truth
    rows: list[tuple[int, int, int]]


def read(path: Path) -> Trace:
    """Return a recorded trace: ``t_send,clock,t_recv,t_mcu_read``, the header giving the exact truth."""
    header, *lines = path.read_text().splitlines()
    value = {key: float(text) for key, text in re.findall(r"(\w+)=([\d.e+-]+)(?=[ ;])", header)}
    truth = Truth(
        value["F"],
        value["drift_ppm"],
        value["ramp_ppm"],
        c0=int(value["c0"]),
        ramp_start_s=value["ramp_start"],
        ramp_s=value["ramp_len"],
    )
    rows = []
    for line in lines:
        sent, clock, received, _ = line.split(",")
        rows.append((round(float(sent) * 1e9), round(float(received) * 1e9), int(clock)))
    return Trace(truth, rows)


def generate(seed: int, profile: str, *, secondary: bool, until_s: float = 1810.0) -> Trace:
    """Return a trace like the recorded ones. The same arguments give the same trace."""
    rng = random.Random(f"{seed} {profile} {secondary}")
    truth = Truth(64e6, -50, -10, 3366544374) if secondary else Truth(168e6, 50, 10, 1945435922)
    times = [10.0] + [10.05 + 0.0505 * i for i in range(8)]
    t = 10.4138 + rng.uniform(-2e-4, 2e-4)
    while t < until_s:
        times.append(t)
        t += rng.uniform(0.9834, 0.9844)
    rows = []
    for sent_s in times:
        read_s = sent_s + PROFILES[profile].draw(rng)
        received_s = read_s + PROFILES[profile].draw(rng)
        rows.append((round(sent_s * 1e9), round(received_s * 1e9), int(truth(read_s))))
    return Trace(truth, rows)


def feed(estimator: ClockEstimator, trace: Trace) -> Iterator[tuple[float, ClockEstimate]]:
    """Give TRACE to ESTIMATOR; yield (host time from which it is known, estimate) for every sample."""
    for i, (sent_ns, received_ns, clock) in enumerate(trace.rows):
        if i:
            estimator.add(sent_ns, received_ns, clock % (1 << 32))
        else:
            estimator.begin(sent_ns, received_ns, clock >> 32, clock % (1 << 32))
        yield received_ns * 1e-9, estimator.estimate()


def estimates(trace: Trace) -> list[tuple[float, ClockEstimate]]:
    """Return (host time from which it is known, estimate) for every sample."""
    return list(feed(ClockEstimator(round(trace.truth.freq_hz)), trace))


def at_steps(
    known: list[tuple[float, ClockEstimate]], step_s: float
) -> Iterator[tuple[float, ClockEstimate]]:
    """Yield (moment, the newest estimate known by then) every STEP_S from the first to the last."""
    i, t = 0, known[0][0]
    while t < known[-1][0]:
        while i + 1 < len(known) and known[i + 1][0] <= t:
            i += 1
        yield t, known[i][1]
        t += step_s


@dataclass
class Score:
    """Errors of the secondary relative to the primary, and how honest each one's own bound was."""

    phases_us: tuple[float, float, float]
    """Rms before, during and after the ramp, from SETTLED_S on."""
    worst_us: float
    late_s: float
    """The last moment the error was over GOOD_S, from the first sample."""
    settled_us: float
    """Error SETTLED_S after the first sample."""
    settled_sd_us: float
    """... and its standard deviation as the estimates themselves have it."""
    dishonest: int
    moments: int
    """Own errors over the published bound, at the moment itself or a second later, of so many moments."""
    looseness: float
    """Median of the published bound over the rms error."""


def rms_us(values: list[float]) -> float:
    """Return the root of the mean square of VALUES (s) in µs."""
    return 1e6 * math.sqrt(sum(x * x for x in values) / len(values))


def score(main: Trace, secondary: Trace, confidence: float = 4.0) -> Score:
    """Return how well the estimator follows SECONDARY relative to MAIN."""
    of_main, of_secondary = estimates(main), estimates(secondary)
    first_s = main.rows[0][0] * 1e-9
    phases: tuple[list[float], ...] = ([], [], [])
    late_s, settled = 0.0, (0.0, 0.0)
    start, end = main.truth.ramp_start_s, main.truth.ramp_start_s + main.truth.ramp_s
    # Both are sampled alike; the moment is the later of the two.
    for (t, mine), (_, other) in zip(at_steps(of_main, STEP_S), at_steps(of_secondary, STEP_S), strict=False):
        believed_ns = mine.ns_at(Ticks(round(main.truth(t))))
        error_s = (other.ticks_at(HostTime(believed_ns)) - secondary.truth(t)) / secondary.truth.freq_hz
        if t < first_s + SETTLED_S:
            settled = error_s, math.hypot(mine.error_s, other.error_s) / confidence
        else:
            phases[(t >= start) + (t >= end)].append(error_s)
        if abs(error_s) > GOOD_S:
            late_s = t - first_s
    own = [honesty(main, of_main), honesty(secondary, of_secondary)]
    return Score(
        (rms_us(phases[0]), rms_us(phases[1]), rms_us(phases[2])),
        1e6 * max(abs(x) for phase in phases for x in phase),
        late_s,
        1e6 * settled[0],
        1e6 * settled[1],
        own[0][0] + own[1][0],
        own[0][1] + own[1][1],
        (own[0][2] + own[1][2]) / 2,
    )


def honesty(trace: Trace, known: list[tuple[float, ClockEstimate]]) -> tuple[int, int, float]:
    """Return (errors over the published bound, of so many, median bound over rms error)."""
    over, errors, bounds = 0, [], []
    for _, estimate in known:
        for ahead_ns in (0, 1_000_000_000):
            at_ns = HostTime(estimate.at_ns + ahead_ns)
            error_s = (estimate.ticks_at(at_ns) - trace.truth(at_ns * 1e-9)) / trace.truth.freq_hz
            over += abs(error_s) > estimate.error_s
            errors.append(error_s)
        bounds.append(estimate.error_s)
    settled = errors[len(errors) // 10 :]
    return over, len(errors), 1e6 * sorted(bounds)[len(bounds) // 2] / rms_us(settled)
