"""What has to be the same on every processor; run by each processor's own Python.

    python results.py FOLDER PLAN.json

FOLDER gets a folder of command streams for each plan, and traces.json: a hash of each simulated run.
"""

import json
import sys
from pathlib import Path

from coordinator.cli.main import main
from coordinator.simulate.run import run_one
from coordinator.simulate.scenario import find

LIMIT_S = 600.0
"""Of one seed, on an emulated processor."""


def make(folder: Path, plans: dict[str, list[str]], runs: list[tuple[str, int]]) -> int:
    """Plan PLANS (configuration and program by name) and simulate RUNS (scenario and seed)."""
    for name, words in plans.items():
        if status := main(["plan", "--output", str(folder / name), *words]):
            return status
    traces = {}
    for scenario, seed in runs:
        result = run_one(find(scenario), seed, LIMIT_S)
        traces[f"{scenario} {seed}"] = {
            "ok": result.ok,
            "steps": result.steps,
            "events": result.events,
            "trace": result.trace,
            "violations": [str(violation) for violation in result.violations],
        }
    (folder / "traces.json").write_text(json.dumps(traces, indent=1), encoding="utf-8")
    return 0


if __name__ == "__main__":
    asked = json.loads(Path(sys.argv[2]).read_text(encoding="utf-8"))
    sys.exit(make(Path(sys.argv[1]), asked["plans"], asked["runs"]))
