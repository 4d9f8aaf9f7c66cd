"""What motion costs: whole plans beside the peer's, step generation alone, and how the cost grows.

    python bench/motion.py [--runs N] [--prove] [--only PART] [CONFIG.cfg ... FILE.gcode ...]

Parts: plans (whole ``canductor plan`` processes, start-up included, median CPU time; below the table the same
of a program without a move, which is what a start costs), generation (steps per
second of CPU time, one core), scaling (length of the file, microsteps, length of the segments). --prove
replays every emitted command of each plan and compares every step with an independent evaluation.
Without files: those beside the project if they are there, else the demo's.
"""

import argparse
import json
import os
import re
import resource
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import product
from math import cos, pi, sin
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from coordinator.motion.specs import NodeStreamSpec, StepperSpec
from coordinator.motion.steps.steps import StepGenerator
from coordinator.verification.planned import epochs
from tests.coordinator.motion.exact_program import Planned, plan_program

ROOT = Path(__file__).resolve().parents[1]
DATA = ROOT.parent / "shared" / "data"
CANDUCTOR = Path(sys.executable).parent / "canductor"
PROGRAMS = ("text_cube", "vase", "circles01")
MACHINES = ("cartesian_plain", "corexy_is_pa", "corexy_is_pa_toolhead")


@dataclass(frozen=True)
class Cost:
    """One plan."""

    cpu_s: float
    rss_mb: float
    steps: int
    queue_steps: int
    size: int
    """Bytes to the nodes, framing included."""
    worst_us: float = 0.0
    moves: int = 0


PEER = {
    ("text_cube", "cartesian_plain"): Cost(3.23, 45, 27_844_345, 549_795, 4_728_152, 25),
    ("vase", "cartesian_plain"): Cost(3.89, 52, 17_198_950, 710_462, 6_039_510, 25),
    ("circles01", "cartesian_plain"): Cost(1.37, 55, 1_664_739, 18_010, 149_869, 25),
    ("text_cube", "corexy_is_pa"): Cost(4.93, 47, 38_922_227, 651_379, 5_531_915, 25),
    ("vase", "corexy_is_pa"): Cost(7.13, 51, 21_738_533, 667_970, 5_562_576, 25),
    ("circles01", "corexy_is_pa"): Cost(2.73, 56, 2_344_993, 20_737, 173_339, 25),
    ("text_cube", "corexy_is_pa_toolhead"): Cost(5.10, 47, 38_922_227, 639_903, 5_394_122, 25),
    ("vase", "corexy_is_pa_toolhead"): Cost(7.41, 51, 21_738_533, 657_669, 5_451_347, 25),
    ("circles01", "corexy_is_pa_toolhead"): Cost(2.31, 56, 2_344_993, 20_674, 169_317, 25),
}
"""The most used open host on the same kind of machine; homing (405,600 steps, 0.55 s of CPU) is included."""


# ---------------------------------------------------------------------------------------- whole plans


def plan_once(config: Path, gcode: Path) -> Cost:
    """Run ``canductor plan`` and take the kernel's word for what it cost.

    Python may keep what it compiled, as where it is installed; else a third of a second is its compiler's.
    """
    with tempfile.TemporaryFile() as out:
        process = subprocess.Popen(
            [str(CANDUCTOR), "plan", str(config), str(gcode), "--json"],
            stdout=out,
            stderr=subprocess.STDOUT,
            env={name: value for name, value in os.environ.items() if name != "PYTHONDONTWRITEBYTECODE"},
        )
        _, status, usage = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
        out.seek(0)
        text = out.read().decode()
    if process.returncode:
        sys.exit(text)
    report: dict[str, Any] = json.loads(text.splitlines()[-1])
    return Cost(
        usage.ru_utime + usage.ru_stime,
        report["peak_rss_mb"],
        report["steps"],
        report["queue_steps"],
        report["bytes_to_nodes"],
        max(s["worst_error_us"] for s in report["steppers"]),
        report["moves"],
    )


def plan_often(config: Path, gcode: Path, runs: int) -> Cost:
    found = [plan_once(config, gcode) for _ in range(runs)]
    cpu_s, rss_mb = (statistics.median(getattr(c, name) for c in found) for name in ("cpu_s", "rss_mb"))
    return replace(found[-1], cpu_s=cpu_s, rss_mb=rss_mb)


def table_of_plans(configs: Sequence[Path], programs: Sequence[Path], runs: int) -> None:
    print(f"whole plans, median of {runs}; below each row: the peer's figures and ours as a share of them")
    print(
        f"{'program, machine':34}{'CPU s':>8}{'MB':>6}{'steps':>12}{'queue_steps':>13}{'bytes':>11}{'us':>7}"
    )
    with tempfile.TemporaryDirectory() as folder:
        for program, config in product(programs, configs):
            ours = plan_often(config, as_the_peer_reads(program, Path(folder)), runs)
            print(row(f"{program.stem}, {config.stem}", ours))
            if (peer := PEER.get((program.stem, config.stem))) is not None:
                print(row("    peer", peer))
                print(
                    f"{'    share':34}{ours.cpu_s / peer.cpu_s:8.3f}{ours.rss_mb / peer.rss_mb:6.2f}"
                    f"{ours.steps / peer.steps:12.3f}{ours.queue_steps / peer.queue_steps:13.3f}"
                    f"{ours.size / peer.size:11.3f}{ours.worst_us / peer.worst_us:7.2f}"
                )
        empty = Path(folder) / "empty.gcode"
        empty.write_text("")
        for config in configs:
            print(row(f"start, {config.stem}", plan_often(config, empty, runs)))


def as_the_peer_reads(program: Path, folder: Path) -> Path:
    """Return a copy of PROGRAM without what has no effect on the peer: M204 with P or T alone."""
    copy = folder / program.name
    copy.write_text(re.sub(r"(?m)^M204 [PT][\d.]+[ \t]*$", ";", program.read_text(encoding="utf-8")))
    return copy


def row(name: str, c: Cost) -> str:
    return (
        f"{name:34}{c.cpu_s:8.3f}{c.rss_mb:6.1f}{c.steps:12,}{c.queue_steps:13,}{c.size:11,}{c.worst_us:7.2f}"
    )


def prove(configs: Sequence[Path], programs: Sequence[Path]) -> None:
    print("every single step, by replaying the emitted commands: checked, outside its band, worst error")
    begin_s = time.process_time()
    wrong = 0
    for program, config in product(programs, configs):
        plan = plan_program(config, program)
        for v in plan.prove():
            exact = v.position == v.wanted_position and v.emitted == v.wanted - plan.left_out(v.name)
            wrong += v.outside + (not exact)
            print(
                f"{program.stem + ', ' + config.stem:34} {v.name:10} {v.checked:12,} {v.outside:6} "
                f"{v.worst_s * 1e6:8.4f} us  number and end of steps {'exact' if exact else 'WRONG'}"
            )
        cpu_s, begin_s = time.process_time() - begin_s, time.process_time()
        print(f"{'':34} {cpu_s:.1f} s of CPU, at most {peak_rss_mb():.0f} MB so far")
    if wrong:
        sys.exit(f"{wrong} faults")


def peak_rss_mb() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


# ------------------------------------------------------------------------------------ step generation

ROUNDS = 3


MIDDLE = (125.0, 125.0, 0.0, 0.0)
"""Of the bed the programs are sliced for; machines without a corner have it at their origin."""
OUTER = 1 - 0.5**0.5
MZV_50_HZ = ((OUTER, -0.0075), (1 - 2 * OUTER, 0.0), (OUTER, 0.0075))
"""Undamped."""
ADVANCE_S, SMOOTH_S = 0.04, 0.04


@dataclass(frozen=True)
class Generation:
    """Steppers to make steps for."""

    name: str
    steppers: Sequence[StepperSpec]
    origin: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0)
    shaped: bool = False
    advanced: bool = False


def generation_cases() -> Iterator[Generation]:
    cartesian, corexy = [(1.0, 0, 0, 0), (0, 1.0, 0, 0)], [(1.0, 1.0, 0, 0), (1.0, -1.0, 0, 0)]
    extruder = linear([(0, 0, 0, 1.0)], 0.0014174)
    yield Generation("cartesian x and y", linear(cartesian))
    yield Generation("corexy", linear(corexy))
    yield Generation("extruder", extruder)
    yield Generation("cartesian x and y, mzv", linear(cartesian), shaped=True)
    yield Generation("corexy, mzv", linear(corexy), shaped=True)
    yield Generation("extruder, pressure advance", extruder, advanced=True)
    delta, winch = (260.0**2, 130.0, -75.0), (-300.0, 500.0, 900.0)
    rotary = (300.0, 700.0, 150.0, 600.0, cos(2.0), sin(2.0))
    for kind, params in (("delta", delta), ("winch", winch), ("rotary_delta", rotary)):
        distance = 1e-4 if kind == "rotary_delta" else 0.00625
        specs = [curved(kind, params, distance)]
        for shaped in (False, True):
            yield Generation(kind + ", mzv" * shaped, specs, MIDDLE, shaped)
    yield Generation("deltesian", [curved("deltesian", (300.0**2, -150.0), 0.00625)], MIDDLE)
    yield Generation("polar radius", [curved("polar_radius", (), 0.00625)], (-10.0, -10.0, 0, 0))
    yield Generation("polar angle", [curved("polar_angle", (), 1e-4)], (-10.0, -10.0, 0, 0))


def linear(
    weights: Iterable[tuple[float, float, float, float]], distance: float = 0.00625
) -> list[StepperSpec]:
    return [StepperSpec(f"s{i}", 0, i, w, distance, False, 1e-7) for i, w in enumerate(weights)]


def curved(kind: str, params: tuple[float, ...], distance: float) -> StepperSpec:
    return StepperSpec("s", 0, 0, (0.0, 0.0, 0.0, 0.0), distance, False, 1e-7, kind, params)


def generator(case: Generation, start: Sequence[float]) -> StepGenerator:
    node = NodeStreamSpec("mcu", 168_000_000, 1024, 11, 12, 13)
    gen = StepGenerator(case.steppers, [node], start=(start[0], start[1], start[2], start[3]))
    if case.shaped:
        for axis in (0, 1):
            gen.set_shaper(axis, MZV_50_HZ)
    if case.advanced:
        gen.set_smooth_time(0, SMOOTH_S)
    return gen


def generation_cost(case: Generation, moves: Any) -> tuple[float, int, int]:
    """Return CPU seconds, steps and queue_steps of MOVES (struct trapezoid) for CASE."""
    moves = moves.copy()
    moves["start"] -= case.origin
    printing = (moves["ratio"][:, 3] > 0) & (moves["ratio"][:, :2] != 0).any(axis=1)
    moves["pressure_advance"] = ADVANCE_S * printing * case.advanced
    gen = generator(case, [float(v) for v in moves["start"][0]])
    moves["print_time"] += gen.next_move_s
    at, cpu, done, last = 0, 0.0, False, moves[-1]
    end = float(last["print_time"] + last["accel_s"] + last["cruise_s"] + last["decel_s"])
    while not done:
        begin = time.process_time()
        at += gen.append(moves[at : at + 4096], min(4096, len(moves) - at))
        whole = at == len(moves)
        done = gen.generate(end + 1.0 if whole else float(moves["print_time"][at]) - 1e-6, flush=whole)
        cpu += time.process_time() - begin
        while gen.take_batch(0, 1 << 18):
            pass
        done &= whole
    stats = gen.stats().steppers
    return cpu, sum(s.steps for s in stats), sum(s.queue_steps for s in stats)


def table_of_generation(planned: Planned) -> None:
    moves = np.concatenate([piece for _, piece in epochs(planned.record) if len(piece)])
    print(f"step generation alone, {len(moves):,} moves, best of {ROUNDS}, one core")
    for case in generation_cases():
        cpu, steps, queued = min(generation_cost(case, moves) for _ in range(ROUNDS))
        rate, share = steps / cpu / 1e6, steps / queued
        print(f"{case.name:34}{cpu:8.3f} s {rate:8.1f} M steps/s {share:8.1f} per queue_step")


# --------------------------------------------------------------------------------------------- scaling


def table_of_scaling(config: Path, program: Path, runs: int) -> None:
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        nothing = folder / "nothing.gcode"
        nothing.write_text("G28\nG90\nG1 X1 Y1 F6000\n")
        start_s = plan_often(config, nothing, max(runs, 3)).cpu_s
        for title, cases in (
            ("length of the file", lengths(program, config, folder)),
            ("microsteps", microsteps(program, config, folder)),
            ("length of the segments", segments(config, folder)),
        ):
            print(f"scaling with the {title}: median of {runs} less the start-up of {start_s:.3f} s")
            columns = f"{'CPU s':>8}{'moves':>10}{'steps':>13}{'queue_steps':>13}{'us/move':>9}{'ns/step':>9}"
            print(f"{'':34}{columns}")
            for case, machine, gcode in cases:
                c = plan_often(machine, gcode, runs)
                cpu_s = c.cpu_s - start_s
                print(
                    f"{case:34}{cpu_s:8.3f}{c.moves:10,}{c.steps:13,}{c.queue_steps:13,}"
                    f"{cpu_s / c.moves * 1e6:9.2f}{cpu_s / c.steps * 1e9:9.2f}"
                )


Case = tuple[str, Path, Path]


def lengths(program: Path, config: Path, folder: Path) -> Iterator[Case]:
    lines = program.read_text().splitlines(keepends=True)
    for share in (8, 4, 2, 1):
        part = folder / f"part{share}.gcode"
        part.write_text("".join(lines[: len(lines) // share]))
        yield f"1/{share} of {program.stem}", config, part
    double = folder / "double.gcode"
    body = [line for line in lines if not line.startswith("G28")]
    double.write_text("".join([*lines, *body]))
    yield f"twice {program.stem}", config, double


def microsteps(program: Path, config: Path, folder: Path) -> Iterator[Case]:
    text = config.read_text()
    for count in (16, 32, 64, 128, 256):
        machine = folder / f"microsteps{count}.cfg"
        # Pulses of 100 ns: 256 microsteps at full speed are more than 250,000 steps/s.
        changed = re.sub(r"(?m)^microsteps:.*$", f"microsteps: {count}\nstep_pulse_duration: 0.0000001", text)
        machine.write_text(changed)
        yield f"{count} microsteps, {program.stem}", machine, program


def segments(config: Path, folder: Path) -> Iterator[Case]:
    """Circles of 20 mm radius, 40 m in all, cut into segments."""
    way, radius = 40_000.0, 20.0
    for length in (2.0, 1.0, 0.5, 0.2, 0.1):
        gcode = folder / f"segments{length}.gcode"
        angle = length / radius
        with gcode.open("w") as out:
            out.write("G28\nG90\nM83\nG1 X120 Y100 Z1 F6000\n")
            for i in range(1, int(way / length) + 1):
                x, y = 100 + radius * cos(i * angle % (2 * pi)), 100 + radius * sin(i * angle % (2 * pi))
                out.write(f"G1 X{x:.3f} Y{y:.3f} E{length * 0.033:.5f}\n")
        yield f"segments of {length} mm", config, gcode


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("files", nargs="*", type=Path)
    parser.add_argument("--runs", type=int, default=3)
    parser.add_argument("--prove", action="store_true")
    parser.add_argument("--only", choices=("plans", "generation", "scaling", "prove"))
    chosen = parser.parse_args()
    configs = [f for f in chosen.files if f.suffix == ".cfg"]
    programs = [f for f in chosen.files if f.suffix != ".cfg"]
    if not configs:
        configs = [DATA / "config" / f"{name}.cfg" for name in MACHINES]
        configs = [c for c in configs if c.exists()] or [ROOT / "config/demo/machine.cfg"]
    if not programs:
        programs = [DATA / "gcode" / f"{name}.gcode" for name in PROGRAMS]
        programs = [p for p in programs if p.exists()] or [ROOT / "config/demo/part.gcode"]
    if chosen.only in {None, "plans"}:
        table_of_plans(configs, programs, chosen.runs)
    if chosen.only in {None, "generation"}:
        table_of_generation(plan_program(configs[0], programs[0]))
    if chosen.only in {None, "scaling"}:
        table_of_scaling(configs[0], programs[0], chosen.runs)
    if chosen.prove or chosen.only == "prove":
        prove(configs, programs)


if __name__ == "__main__":
    main()
