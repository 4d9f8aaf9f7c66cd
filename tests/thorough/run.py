"""``make thorough``: runs every step, prints one table at the end; exit status 1 if any failed.

    python -m tests.thorough.run [STEP…] [--seeds N] [--sample N] [--seed N]
        [--fuzz-seconds N] [--soak-minutes M]

The output of each step is in build/thorough/STEP.log.
"""

import argparse
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from tests.thorough.steps import Amount, Step, steps

ROOT: Final = Path(__file__).resolve().parents[2]
LOGS: Final = ROOT / "build" / "thorough"
TAIL: Final = 30
"""Lines that are shown of a step that failed."""


@dataclass(frozen=True, slots=True)
class Done:
    """How a step ended."""

    name: str
    passed: bool
    figure: str
    seconds: float


def run(step: Step, logs: Path = LOGS) -> Done:
    """Run STEP; its output goes to a file in LOGS, and its end here when it fails."""
    logs.mkdir(parents=True, exist_ok=True)
    path = logs / f"{step.name}.log"
    began_s = time.monotonic()
    with path.open("wb") as log:
        status = subprocess.run(
            step.command,
            cwd=ROOT,
            stdin=subprocess.DEVNULL,
            stdout=log,
            stderr=subprocess.STDOUT,
            check=False,
        ).returncode
    output = path.read_text(encoding="utf-8", errors="replace")
    if status:
        sys.stdout.write("".join(f"    {line}\n" for line in output.splitlines()[-TAIL:]))
    return Done(step.name, status == 0, step.figure_of(output), time.monotonic() - began_s)


def table(results: Sequence[Done]) -> str:
    """Return what, verdict, figure and seconds of RESULTS, in columns."""
    rows = [("what", "verdict", "seconds", "figure")]
    rows += [
        (done.name, "passed" if done.passed else "FAILED", f"{done.seconds:.0f}", done.figure)
        for done in results
    ]
    widths = [max(len(row[k]) for row in rows) for k in range(3)]
    return "".join(
        f"{what:<{widths[0]}}  {verdict:<{widths[1]}}  {seconds:>{widths[2]}}  {figure}\n"
        for what, verdict, seconds, figure in rows
    )


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the steps; return the exit status."""
    usual = Amount()
    names = [step.name for step in steps(usual)]
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("steps", nargs="*", metavar="STEP", help=f"only these: {', '.join(names)}")
    parser.add_argument("--seeds", type=int, default=usual.seeds)
    parser.add_argument("--sample", type=int, default=usual.sample)
    parser.add_argument("--seed", type=int, default=usual.seed)
    parser.add_argument("--fuzz-seconds", type=int, default=usual.fuzz_s)
    parser.add_argument("--soak-minutes", type=float, default=usual.soak_minutes)
    given = parser.parse_args(arguments)
    if unknown := set(given.steps) - set(names):
        parser.error(f"there is no step {', '.join(sorted(unknown))}")
    amount = Amount(given.seeds, given.sample, given.seed, given.fuzz_seconds, given.soak_minutes)
    results = []
    for step in steps(amount):
        if not given.steps or step.name in given.steps:
            sys.stdout.write(f"{step.name}: {step.about}\n")
            sys.stdout.flush()
            results.append(run(step))
    sys.stdout.write("\n" + table(results))
    return 0 if all(done.passed for done in results) else 1


if __name__ == "__main__":
    sys.exit(main())
