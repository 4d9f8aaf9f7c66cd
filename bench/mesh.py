"""What a bed mesh costs: CPU of a plan with and without one.

    python bench/mesh.py [FILE.gcode] [--runs 5]

The same file (without one, the demo's part 50 times) is planned on the demo's machine with a mesh of 7 by 7
points loaded, with none, and a file that only loads it, in turn, RUNS times in one process: a computer that
gets slower does so for all of them. A figure is the median of user CPU seconds, without what the short file
costs (the configuration is read). A cost is the median of the costs of pairs.
"""

import argparse
import resource
import statistics
import sys
import tempfile
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from coordinator.planning.options import PlanOptions
from coordinator.planning.plan import plan_file

ROOT = Path(__file__).resolve().parent.parent
MACHINE = ROOT / "config/demo/machine.cfg"
PART = ROOT / "config/demo/part.gcode"
PARTS = 50  # one is planned within a hundredth of a second
POINTS = 7
BOW_MM = 0.3
HALF_MM = 125.0
SHAPERS = "[input_shaper]\nshaper_type: mzv\nshaper_freq_x: 52\nshaper_freq_y: 43\n"
LOAD = "BED_MESH_PROFILE LOAD=bench\n"


def machine_text(*, shaped: bool) -> str:
    """Return the demo's machine with a mesh that was saved."""
    rows = []
    for j in range(POINTS):
        row = [
            BOW_MM * (1 - ((2 * i / (POINTS - 1) - 1) ** 2 + (2 * j / (POINTS - 1) - 1) ** 2))
            + 0.02 * (-1) ** (i * j)
            for i in range(POINTS)
        ]
        rows.append("  " + ", ".join(f"{height:.4f}" for height in row))
    edges = f"min_x: 0\nmax_x: {2 * HALF_MM}\nmin_y: 0\nmax_y: {2 * HALF_MM}\n"
    return (
        MACHINE.read_text(encoding="utf-8")
        + "\n[probe]\npin: toolhead:PC5\nz_offset: 1\n"
        + f"[bed_mesh]\nmesh_min: 0, 0\nmesh_max: {2 * HALF_MM}, {2 * HALF_MM}\n"
        + f"probe_count: {POINTS}\nalgorithm: bicubic\n"
        + "[bed_mesh bench]\nversion: 1\npoints:\n"
        + "\n".join(rows)
        + f"\nx_count: {POINTS}\ny_count: {POINTS}\nmesh_x_pps: 2\nmesh_y_pps: 2\n"
        + "algo: bicubic\ntension: 0.2\n"
        + edges
        + (SHAPERS if shaped else "")
    )


def user_s(config: Path, program: Path) -> float:
    """Return the user CPU seconds of one plan in this process, all threads together."""
    before = resource.getrusage(resource.RUSAGE_SELF).ru_utime
    plan_file(PlanOptions(config=config, gcode=program, json=True))
    return resource.getrusage(resource.RUSAGE_SELF).ru_utime - before


def main() -> None:
    """Print the figures with and without shapers."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("gcode", nargs="?", type=Path)
    parser.add_argument("--runs", type=int, default=5)
    options = parser.parse_args()
    file = options.gcode or PART
    text = file.read_text(encoding="utf-8") * (1 if options.gcode else PARTS)
    print(f"{file.name}, median of {options.runs}: user CPU s of a plan, start-up taken off")
    print(f"{'shapers':8} {'without':>8} {'with mesh':>9} {'cost':>7}   costs of pairs")
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for shaped in (False, True):
            one_machine(folder, text, options.runs, shaped=shaped)


def one_machine(folder: Path, text: str, runs: int, *, shaped: bool) -> None:
    """Measure one machine."""
    config, short, without, mesh = (
        folder / name for name in ("machine.cfg", "short.gcode", "without.gcode", "mesh.gcode")
    )
    config.write_text(machine_text(shaped=shaped), encoding="utf-8")
    short.write_text(f"G28\n{LOAD}", encoding="utf-8")
    without.write_text(text, encoding="utf-8")
    homed = text.replace("G28", f"G28\n{LOAD}", 1)
    mesh.write_text(homed if homed != text else LOAD + text, encoding="utf-8")
    rows = []
    user_s(config, mesh)  # code and tables are loaded
    for _ in range(runs):
        start, plain, bent = (user_s(config, program) for program in (short, without, mesh))
        rows.append((plain - start, bent - start))
    costs = sorted(bent / plain - 1 for plain, bent in rows)
    plain, bent = (statistics.median(column) for column in zip(*rows, strict=True))
    said = ", ".join(f"{cost:.1%}" for cost in costs)
    print(
        f"{'mzv' if shaped else 'none':8} {plain:8.2f} {bent:9.2f} {statistics.median(costs):7.1%}   {said}"
    )


if __name__ == "__main__":
    main()
