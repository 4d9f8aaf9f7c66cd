"""CPU time, memory and size of whole plans: `python bench/plan.py CONFIG... GCODE...` (default: the demo).

Each combination runs three times as a process of its own, start-up included; medians are printed.
"""

import json
import statistics
import subprocess
import sys
from itertools import product
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
RUNS = 3


def plan(config: Path, gcode: Path) -> dict[str, float]:
    """Plan once; ends the benchmark with the tool's own sentence when it fails."""
    command = [str(Path(sys.executable).parent / "canductor"), "plan", str(config), str(gcode), "--json"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    report = json.loads(done.stdout.splitlines()[-1])
    if not report["ok"]:
        sys.exit(report["error"])
    return {name: value for name, value in report.items() if isinstance(value, int | float)}


def main() -> None:
    """Print one row per program and machine."""
    paths = [Path(argument) for argument in sys.argv[1:]]
    configs = [path for path in paths if path.suffix == ".cfg"] or [ROOT / "config/demo/machine.cfg"]
    programs = [path for path in paths if path.suffix != ".cfg"] or [ROOT / "config/demo/part.gcode"]
    head = ("program", "machine", "CPU s", "MB", "steps", "queue_steps", "bytes")
    print("{:12} {:24} {:>6} {:>5} {:>11} {:>11} {:>10}".format(*head))
    for program, config in product(programs, configs):
        runs = [plan(config, program) for _ in range(RUNS)]
        cpu_s = statistics.median(run["cpu_s"] for run in runs)
        peak_mb = max(run["peak_rss_mb"] for run in runs)
        last = runs[-1]
        print(
            f"{program.stem:12} {config.stem:24} {cpu_s:6.2f} {peak_mb:5.0f} {last['steps']:11,} "
            f"{last['queue_steps']:11,} {last['bytes_to_nodes']:10,}"
        )


if __name__ == "__main__":
    main()
