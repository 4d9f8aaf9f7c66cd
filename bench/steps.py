"""Speed and yield of step generation: by kind of phase, and over the moves of a g-code file.

    python bench/steps.py [FILE.gcode]

The file's moves are planned here with a plain look-ahead, so that this measures step generation alone.
"""

import math
import re
import sys
import time
from collections.abc import Iterable, Iterator
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from coordinator.motion.specs import NodeStreamSpec, StepperSpec
from coordinator.motion.steps.steps import StepGenerator

ACCEL = 7000.0
CORNER_V = 8.0
WORD = re.compile(r"([XYZEF])(-?[\d.]+)")
Row = list[float]
Rows = np.ndarray[tuple[int, int], np.dtype[np.float64]]
Position = tuple[float, float, float, float]


def machine(freq: int = 168_000_000, *, corexy: bool = False, microsteps: int = 32) -> StepGenerator:
    node = NodeStreamSpec("mcu", freq, 1024, 11, 12, 13)
    xy = [(1.0, 1.0, 0.0, 0.0), (1.0, -1.0, 0.0, 0.0)] if corexy else [(1.0, 0, 0, 0), (0.0, 1, 0, 0)]
    weights = [*xy, (0.0, 0.0, 1.0, 0.0), (0.0, 0.0, 0.0, 1.0)]
    distances = [40 / 200 / microsteps] * 2 + [8 / 200 / 16, 22.6789511 / 5 / 200 / 16]
    steppers = [
        StepperSpec(name, 0, oid, w, d, False, 2e-6)
        for name, oid, w, d in zip(("x", "y", "z", "e"), range(4), weights, distances, strict=True)
    ]
    return StepGenerator(steppers, [node])


def direction(start: Position, end: Position) -> tuple[float, list[float]]:
    delta = [b - a for a, b in zip(start, end, strict=True)]
    length = math.hypot(*delta[:3]) or abs(delta[3])
    return length, [d / length for d in delta]


def trapezoid(t: float, start: Position, end: Position, v: float, joints: tuple[float, float]) -> Row:
    """Plan one move from START to END; its speeds are lowered until it fits."""
    length, ratio = direction(start, end)
    v0, v1 = joints
    v1 = min(v1, math.sqrt(v0 * v0 + 2 * ACCEL * length))
    top = max(v0, v1, min(v, math.sqrt(ACCEL * length + (v0 * v0 + v1 * v1) / 2)))
    ramps = (2 * top * top - v0 * v0 - v1 * v1) / (2 * ACCEL)
    times = [(top - v0) / ACCEL, max(length - ramps, 0) / top, (top - v1) / ACCEL]
    return [t, *times, v0, top, ACCEL, *start, *ratio, 0.0, 0.0]


def corner_speed(before: list[float], after: list[float]) -> float:
    """Return the speed of an arc through the corner (spec 04); E alone stops."""
    cosine = -sum(a * b for a, b in zip(before[:3], after[:3], strict=True))
    sine_half = math.sqrt(max(0.5 * (1 - cosine), 0))
    if not any(before[:3]) or not any(after[:3]):
        return 0.0
    if sine_half > 0.999999:
        return 1e6
    return CORNER_V * math.sqrt((math.sqrt(2) - 1) * sine_half / (1 - sine_half))


def file_moves(path: Path) -> Iterator[tuple[Position, Position, float]]:
    at, speed = {"X": 0.0, "Y": 0.0, "Z": 0.0, "E": 0.0}, 3000.0
    e_relative, e_base = False, 0.0
    for line in path.open():
        command = line.split(";")[0].strip()
        if command.startswith(("M82", "M83")):
            e_relative = command.startswith("M83")
        words = {k: float(v) for k, v in WORD.findall(command)}
        if command.startswith("G92") and "E" in words:
            e_base = at["E"] - words["E"]
        if not command.startswith(("G0 ", "G1 ")):
            continue
        before = tuple(at.values())
        speed = words.pop("F", speed)
        if "E" in words:
            words["E"] += at["E"] if e_relative else e_base
        at.update(words)
        after = tuple(at.values())
        if after != before:
            yield before, after, speed / 60  # type: ignore[misc]


def plan(moves: Iterable[tuple[Position, Position, float]]) -> Rows:
    """Plan the whole file at once: corners, then one pass back and one forth."""
    chain = [
        (start, end, min(speed, 15.0 if start[:2] == end[:2] else 400.0), *direction(start, end))
        for start, end, speed in moves
    ]
    joints = [0.0] * (len(chain) + 1)
    for i in range(len(chain) - 1, 0, -1):
        before, after = chain[i - 1], chain[i]
        reach = math.sqrt(joints[i + 1] ** 2 + 2 * ACCEL * after[3])
        joints[i] = min(corner_speed(before[4], after[4]), before[2], after[2], reach)
    rows: list[Row] = []
    t, joint = 0.3, 0.0
    for i, (start, end, speed, _, _) in enumerate(chain):
        row = trapezoid(t, start, end, speed, (joint, joints[i + 1]))
        rows.append(row)
        joint = max(row[5] - ACCEL * row[3], 0.0)
        t += sum(row[1:4])
    return np.array(rows)


def run(name: str, gen: StepGenerator, rows: Rows) -> None:
    at, nbytes, cpu = 0, 0, 0.0
    end = float(rows[-1, :4].sum())
    while True:
        begin = time.process_time()
        at += gen.append(np.ascontiguousarray(rows[at : at + 4096]), min(4096, len(rows) - at))
        until = end + 0.001 if at == len(rows) else float(rows[at, 0]) - 1e-6
        done = gen.generate(until, flush=at == len(rows))
        cpu += time.process_time() - begin
        while batch := gen.take_batch(0, 1 << 18):
            nbytes += len(batch)
        if done and at == len(rows):
            break
    stats = gen.stats()
    steps = sum(s.steps for s in stats.steppers)
    queued = sum(s.queue_steps for s in stats.steppers)
    node = stats.nodes[0]
    worst = max(s.worst_error_s for s in stats.steppers) * 1e6
    print(
        f"{name:28} {steps:9} steps {steps / cpu / 1e6:6.1f} M/s {steps / queued:7.1f} per queue_step "
        f"{queued:7} queue_steps {node.framed_bytes:8} bytes {node.framed_bytes / steps:.3f} per step "
        f"worst {worst:.1f} us, {cpu:.3f} s"
    )


def single(v: float, length: float, moves: int, accel_share: float) -> Rows:
    """Plan MOVES back and forth along X, ACCEL_SHARE of the way in ramps."""
    rows: list[Row] = []
    t = 0.3
    accel = v * v / (length * accel_share) if accel_share else 0.0
    for i in range(moves):
        ramp = v / accel if accel else 0.0
        cruise = length * (1 - accel_share) / v
        start, way = (0.0, 1.0) if i % 2 == 0 else (length, -1.0)
        rest = [0.0 if accel else v, v, accel, start, 0, 0, 0, way, 0, 0, 0, 0, 0]
        rows.append([t, ramp, cruise, ramp, *rest])
        t += 2 * ramp + cruise
    return np.array(rows)


def main() -> None:
    for freq in (16_000_000, 64_000_000, 168_000_000):
        mhz = freq // 1_000_000
        run(f"cruise, {mhz} MHz", machine(freq), single(173.3, 250, 80, 0))
        run(f"ramps of 25 mm, {mhz} MHz", machine(freq), single(400, 50, 400, 1))
        run(f"ramps of 2 mm, {mhz} MHz", machine(freq), single(120, 4, 5000, 1))
    for microsteps in (16, 64, 256):
        run(
            f"ramps of 2 mm, {microsteps} microsteps", machine(microsteps=microsteps), single(120, 4, 2500, 1)
        )
    for file in sys.argv[1:]:
        rows = plan(file_moves(Path(file)))
        run(Path(file).name, machine(), rows)
        run(f"{Path(file).name} corexy", machine(corexy=True), rows)


if __name__ == "__main__":
    main()
