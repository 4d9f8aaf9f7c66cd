"""Cost of the way from G-code text to trapezoids, per G0/G1 line; CPU time, median of 5.

Usage: bench/planner.py [FILE...]; without files, those beside the project.
"""

import json
import resource
import statistics
import sys
import time
from pathlib import Path

from coordinator.gcode.events import End
from coordinator.gcode.interpreter import Job
from coordinator.gcode.program import Program
from coordinator.motion.planner.planner import Planner
from coordinator.motion.specs import MotionLimits

ROUNDS = 5
GCODE = Path(__file__).parents[1] / ".." / "shared" / "data" / "gcode"
LIMITS = MotionLimits(
    max_velocity=400,
    max_accel=10000,
    max_z_velocity=15,
    max_z_accel=500,
    square_corner_velocity=8,
    minimum_cruise_ratio=0.5,
    position_min=(0, 0, 0),
    position_max=(250, 250, 250),
    max_extrude_only_velocity=120,
    max_extrude_only_accel=3000,
    max_extrude_only_distance=50,
    max_extrude_ratio=2.08,
    instantaneous_corner_velocity=1,
)


def run(path: Path) -> tuple[float, Planner]:
    start = time.process_time()
    with Program.open(path) as program:
        job = Job(program, Planner(LIMITS), {"X": 0.0, "Y": 0.0, "Z": 0.0})
        while not isinstance(job.step(), End):
            while (batch := job.planner.take()).count:
                job.planner.release(batch.count)
    return time.process_time() - start, job.planner


def main() -> None:
    paths = [Path(name) for name in sys.argv[1:]] or sorted(GCODE.glob("*.gcode"))
    if not paths:
        print("no G-code files beside the project: name some")
    for path in paths:
        with path.open("rb") as lines:
            moves = sum(line[:3] in {b"G1 ", b"G0 "} for line in lines)
        runs = [run(path) for _ in range(ROUNDS)]
        cpu_s = statistics.median(cost for cost, _ in runs)
        planner = runs[0][1]
        figures = {
            "file": path.name,
            "lines": planner.lines,
            "move_lines": moves,
            "trapezoids": planner.moves,
            "print_time_s": round(planner.print_time_end_s, 3),
            "cpu_s": round(cpu_s, 4),
            "us_per_move_line": round(cpu_s / moves * 1e6, 3),
            "peak_rss_mb": round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024, 1),
        }
        print(json.dumps(figures))


if __name__ == "__main__":
    main()
