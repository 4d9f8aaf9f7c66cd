"""Error of a secondary node's clock relative to the primary's, before, during and after a temperature ramp.

``bench/clock.py [MAIN.csv SEC.csv …]``: pairs of recorded traces; without arguments, those of
../shared/data/clock when present. ``bench/clock.py --seeds N [--first S]``: N pairs of generated traces per
profile, median and 90th percentile beside the goals. How it is scored: tests/nodes/clock_traces.py.
"""

import argparse
import sys
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from nodes.clock.clock import ClockEstimator
from nodes.clock.start import START_SAMPLES
from tests.nodes import clock_traces as traces

SHARED = Path(__file__).parents[1] / ".." / "shared" / "data" / "clock"


def recorded(paths: list[Path]) -> None:
    if not paths:
        print("no traces given and none in ../shared")
    print(f"{'trace':<28}{'before':>9}{'during':>9}{'after':>9}{'worst':>9} µs   below 50 µs after")
    for first, second in zip(paths[::2], paths[1::2], strict=True):
        found = traces.score(traces.read(first), traces.read(second))
        figures = (*found.phases_us, found.worst_us)
        print(f"{first.stem:<28}" + "".join(f"{x:9.1f}" for x in figures) + f"      {found.late_s:6.1f} s")


def generated(profile: str, seeds: range) -> None:
    """Print one profile's figures over SEEDS."""
    found = [
        traces.score(*(traces.generate(seed, profile, secondary=which) for which in (False, True)))
        for seed in seeds
    ]
    for i, phase in enumerate(("before", "during", "after")):
        ranked = sorted(score.phases_us[i] for score in found)
        middle, high = ranked[len(ranked) // 2], ranked[min(len(ranked) * 9 // 10, len(ranked) - 1)]
        goal = traces.PROFILES[profile].goals_us[i]
        verdict = "" if high <= goal else "   MISSED"
        print(f"{profile} {phase:<8}{middle:8.1f}{high:8.1f}{goal:8.1f} µs{verdict}")
    settled = traces.rms_us([score.settled_us * 1e-6 for score in found])
    own = traces.rms_us([score.settled_sd_us * 1e-6 for score in found])
    over = sum(score.dishonest for score in found) / sum(score.moments for score in found)
    loose = sorted(score.looseness for score in found)[len(found) // 2]
    print(f"{profile} after 5 s: {settled:.0f} µs rms (its own standard deviation: {own:.0f} µs)")
    print(f"{profile} error over its bound: {100 * over:.2f} % of moments; bound / rms error: {loose:.1f}")


def cost() -> None:
    """Print the time a sample takes, in the fit of the first ones and after."""
    trace = traces.generate(0, "C", secondary=False, until_s=600)
    took = []
    known = traces.feed(ClockEstimator(round(trace.truth.freq_hz)), trace)
    for _ in trace.rows:
        began = time.perf_counter()
        next(known)
        took.append(time.perf_counter() - began)
    start, later = took[:START_SAMPLES], took[START_SAMPLES:]
    print(f"a sample takes {1e3 * sum(start) / len(start):.2f} ms in the beginning (mean), ", end="")
    print(f"{1e3 * sum(later) / len(later):.2f} ms later")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("traces", nargs="*", type=Path)
    parser.add_argument("--seeds", type=int, default=0, help="score so many generated pairs per profile")
    parser.add_argument("--first", type=int, default=1000, help="the first seed")
    args = parser.parse_args()
    if args.seeds:
        print(f"{'phase':<10}{'median':>8}{'p90':>8}{'goal':>8}")
        for profile in traces.PROFILES:
            generated(profile, range(args.first, args.first + args.seeds))
    else:
        recorded(args.traces or sorted(SHARED.glob("trace_*.csv")))
    cost()


if __name__ == "__main__":
    main()
