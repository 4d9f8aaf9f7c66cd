"""Error of a secondary node's clock relative to the primary's, before, during and after a temperature ramp.

``bench/clock.py [MAIN.csv SEC.csv …]``: pairs of recorded traces (``t_send,clock,t_recv,t_mcu_read``, the
header giving the exact truth); without arguments, those of ../shared/data/clock when present. The
estimates are causal: at each moment between two samples only what was received by then is used. The first
5 s are not scored in the first phase but reported by "below 50 µs after" (the last moment the error was
larger, from the first sample).
"""

import math
import re
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from nodes.clock import ClockEstimate, ClockEstimator, HostTime, Ticks

SHARED = Path(__file__).parents[1] / ".." / "shared" / "data" / "clock"
SETTLED_S = 5.0
GOOD_S = 50e-6
STEP_S = 0.25


@dataclass
class Trace:
    """A recording with its truth: rows are (sent ns, received ns, clock)."""

    freq_hz: float
    ramp_start_s: float
    ramp_end_s: float
    truth: Callable[[float], float]
    rows: list[tuple[int, int, int]]


def read(path: Path) -> Trace:
    header, *lines = path.read_text().splitlines()
    value = {key: float(text) for key, text in re.findall(r"(\w+)=([\d.e+-]+)(?=[ ;])", header)}
    f, start, length = value["F"], value["ramp_start"], value["ramp_len"]

    def truth(t: float) -> float:
        u, v = min(max(t - start, 0), length), max(t - start - length, 0)
        ramp = value["ramp_ppm"] * (u * u / (2 * length) + v)
        return value["c0"] + f * (t + 1e-6 * (value["drift_ppm"] * t + ramp))

    rows = []
    for line in lines:
        sent, clock, received, _ = line.split(",")
        rows.append((round(float(sent) * 1e9), round(float(received) * 1e9), int(clock)))
    return Trace(f, start, start + length, truth, rows)


def estimates(trace: Trace) -> list[tuple[float, ClockEstimate]]:
    """Return (host time from which it is known, estimate) for every sample."""
    estimator = ClockEstimator(round(trace.freq_hz))
    found = []
    for i, (sent_ns, received_ns, clock) in enumerate(trace.rows):
        if i:
            estimator.add(sent_ns, received_ns, clock % (1 << 32))
        else:
            estimator.begin(sent_ns, received_ns, clock >> 32, clock % (1 << 32))
        found.append((received_ns * 1e-9, estimator.estimate()))
    return found


def errors(main: Trace, secondary: Trace) -> list[tuple[float, float]]:
    """Return (host time, error of the secondary's clock in s), when the primary's clock is what counts."""
    of_main, of_secondary = estimates(main), estimates(secondary)
    result = []
    i = j = 0
    t = max(of_main[0][0], of_secondary[0][0])
    while t < of_main[-1][0]:
        while i + 1 < len(of_main) and of_main[i + 1][0] <= t:
            i += 1
        while j + 1 < len(of_secondary) and of_secondary[j + 1][0] <= t:
            j += 1
        believed_ns = of_main[i][1].ns_at(Ticks(round(main.truth(t))))
        ticks = of_secondary[j][1].ticks_at(HostTime(believed_ns))
        result.append((t, (ticks - secondary.truth(t)) / secondary.freq_hz))
        t += STEP_S
    return result


def rms_us(values: list[float]) -> float:
    return 1e6 * math.sqrt(sum(x * x for x in values) / len(values))


def score(main: Path, secondary: Path) -> tuple[float, float, float, float, float]:
    """Return rms before, during and after the ramp, the largest settled error (µs), and the time to 50 µs."""
    trace = read(main)
    found = errors(trace, read(secondary))
    first_s = trace.rows[0][0] * 1e-9
    phases: tuple[list[float], list[float], list[float]] = ([], [], [])
    for t, error_s in found:
        if t >= first_s + SETTLED_S:
            phases[(t >= trace.ramp_start_s) + (t >= trace.ramp_end_s)].append(error_s)
    late_s = max((t - first_s for t, error_s in found if abs(error_s) > GOOD_S), default=0.0)
    worst_us = 1e6 * max(abs(x) for phase in phases for x in phase)
    before, during, after = (rms_us(phase) for phase in phases)
    return before, during, after, worst_us, late_s


def main() -> None:
    paths = [Path(arg) for arg in sys.argv[1:]] or sorted(SHARED.glob("trace_*.csv"))
    if not paths:
        print("no traces given and none in ../shared")
    print(f"{'trace':<28}{'before':>9}{'during':>9}{'after':>9}{'worst':>9} µs   below 50 µs after")
    for first, second in zip(paths[::2], paths[1::2], strict=True):
        *figures, late_s = score(first, second)
        print(f"{first.stem:<28}" + "".join(f"{x:9.1f}" for x in figures) + f"      {late_s:6.1f} s")


if __name__ == "__main__":
    main()
