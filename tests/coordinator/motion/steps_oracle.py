"""A slow, obvious twin of step generation: times by bisection, and the node's side of the commands.

Nothing here shares code with the generator; only the rules of steps.h are the same.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from coordinator.motion.specs import NodeStreamSpec, StepperSpec

Position = tuple[float, float, float, float]
LONG = np.longdouble
Longs = np.ndarray[tuple[int], np.dtype[np.longdouble]]
TIE_STEPS = 1 / 1048576
SLACK_TICKS = 2
BISECTIONS = 70
"""A move of 1,000 s is then known to 1e-18 s: below the resolution of a long double, which has 64 bits."""


@dataclass(frozen=True)
class Move:
    """A trapezoid by its numbers."""

    print_time: float
    seconds: tuple[float, float, float]
    start_v: float
    cruise_v: float
    accel: float
    start: Position
    ratio: Position

    def row(self) -> list[float]:
        head = [self.print_time, *self.seconds, self.start_v, self.cruise_v, self.accel]
        return [*head, *self.start, *self.ratio, 0.0, 0.0]  # no pressure advance, of no line

    def way(self, t: Longs) -> Longs:
        """Return s after T seconds, straight from the definition of a trapezoid."""
        ta, tc, td = (LONG(s) for s in self.seconds)
        v0, v, a = LONG(self.start_v), LONG(self.cruise_v), LONG(self.accel)
        zero = LONG(0)
        t1 = np.minimum(np.maximum(t, zero), ta)
        t2 = np.minimum(np.maximum(t - ta, zero), tc)
        t3 = np.minimum(np.maximum(t - ta - tc, zero), td)
        way: Longs = v0 * t1 + a * t1 * t1 / 2 + v * t2 + v * t3 - a * t3 * t3 / 2
        return way

    @property
    def total_s(self) -> float:
        return self.seconds[0] + self.seconds[1] + self.seconds[2]

    @property
    def end(self) -> Position:
        way = float(self.way(np.full(1, LONG(self.total_s)))[0])
        x, y, z, e = (p + r * way for p, r in zip(self.start, self.ratio, strict=True))
        return x, y, z, e


def make_move(
    t: float, start: Position, end: Position, speeds: tuple[float, float, float], accel: float
) -> Move:
    """Return a move with start, cruise and end speed, lowered until they fit the length."""
    delta = [b - a for a, b in zip(start, end, strict=True)]
    length = math.sqrt(sum(d * d for d in delta[:3])) or abs(delta[3])
    top = speeds[1]
    v0, v1 = min(speeds[0], top), min(speeds[2], top)
    v1 = min(v1, math.sqrt(v0 * v0 + 2 * accel * length))
    v0 = min(v0, math.sqrt(v1 * v1 + 2 * accel * length))
    top = min(top, math.sqrt(accel * length + (v0 * v0 + v1 * v1) / 2))
    cruise = max(length - (2 * top * top - v0 * v0 - v1 * v1) / (2 * accel), 0) / top
    x, y, z, e = (d / length for d in delta)
    return Move(t, ((top - v0) / accel, cruise, (top - v1) / accel), v0, top, accel, start, (x, y, z, e))


@dataclass
class Step:
    """One step by its true print time (s), as wide as its band may be."""

    time: float
    direction: int
    band_s: float = 0.0


def _mix(spec: StepperSpec, at: Sequence[float]) -> float:
    return float(sum(w * a for w, a in zip(spec.weights, at, strict=True)))


def _position(u: float, position: int) -> int:
    nearest = math.floor(u + 0.5)
    past = abs(u - position) - 0.5
    between = abs(u - math.floor(u) - 0.5) <= TIE_STEPS
    if past <= TIE_STEPS:
        return position
    return (math.floor(u) if u > position else math.floor(u) + 1) if between else nearest


def step_times(
    spec: StepperSpec, freq: float, moves: Sequence[Move], start: Position, max_error_s: float
) -> list[Step]:
    """Return every step STEPPER has to do, with its band."""
    origin = _mix(spec, start) / spec.step_distance
    closest = (max(math.ceil(2 * spec.step_pulse_s * freq), 1) + SLACK_TICKS) / freq
    steps: list[Step] = []
    position = 0
    for move in moves:
        target = _position(_mix(spec, move.end) / spec.step_distance - origin, position)
        ratio = LONG(_mix(spec, move.ratio)) / LONG(spec.step_distance)
        direction = 1 if ratio > 0 else -1
        if ratio == 0 or (target - position) * direction <= 0:
            continue
        begin = LONG(_mix(spec, move.start)) / LONG(spec.step_distance) - LONG(origin)
        number = np.arange(abs(target - position)).astype(LONG)
        wanted = (LONG(position) + direction * (number + LONG(0.5)) - begin) / ratio
        low = np.zeros(len(wanted), LONG)
        high = np.full(len(wanted), LONG(move.total_s))
        for _ in range(BISECTIONS):
            middle: Longs = (low + high) / LONG(2)
            before = move.way(middle) < wanted
            low, high = np.where(before, middle, low), np.where(before, high, middle)
        for t in high:
            _add(steps, Step(float(LONG(move.print_time) + t), direction), closest)
        position = target
    _widen(steps, max_error_s)
    return steps


def _add(steps: list[Step], step: Step, closest: float) -> None:
    if steps and steps[-1].direction != step.direction and step.time - steps[-1].time < closest:
        steps.pop()
    else:
        steps.append(step)


def _widen(steps: list[Step], max_error_s: float) -> None:
    for i, step in enumerate(steps):
        before = step.time - steps[i - 1].time if i else math.inf
        behind = steps[i + 1].time - step.time if i + 1 < len(steps) else math.inf
        step.band_s = min(max_error_s, before / 2, behind / 2)


# ------------------------------------------------------------------------------------- the node's side


@dataclass
class Record:
    """One command of a batch, decoded."""

    min_clock: int
    req_clock: int
    name: str
    oid: int
    values: list[int]
    first: int = 0
    finish: int = 0
    size: int = 0


@dataclass
class Motor:
    """A stepper as the node runs it: 32-bit clocks, unwrapped beside the command's req_clock."""

    clock: int | None = None
    finish: int = 0
    direction: int | None = None
    steps: list[tuple[int, int]] = field(default_factory=list)
    intervals: list[int] = field(default_factory=list)


def unpack(batch: bytes) -> list[tuple[int, int, bytes]]:
    records, at = [], 0
    while at < len(batch):
        min_clock = int.from_bytes(batch[at : at + 8], "little")
        req_clock = int.from_bytes(batch[at + 8 : at + 16], "little")
        size = batch[at + 16]
        payload = batch[at + 17 : at + 17 + size]
        assert len(payload) == size
        records.append((min_clock, req_clock, payload))
        at += 17 + size
    return records


def read_values(payload: bytes) -> list[int]:
    """Decode VLQ values as signed 32-bit numbers."""
    values, at = [], 0
    while at < len(payload):
        value = payload[at] & 0x7F
        if value & 0x60 == 0x60:
            value -= 0x80
        while payload[at] & 0x80:
            at += 1
            value = value << 7 | payload[at] & 0x7F
        at += 1
        values.append((value + (1 << 31)) % (1 << 32) - (1 << 31))
    return values


class Node:
    """Executes a batch as spec 03 has it and remembers every step."""

    def __init__(self, spec: NodeStreamSpec, steppers: Sequence[StepperSpec]) -> None:
        self.spec = spec
        self.names = {
            spec.queue_step_id: "queue_step",
            spec.set_next_step_dir_id: "set_next_step_dir",
            spec.reset_step_clock_id: "reset_step_clock",
        }
        self.invert = {s.oid: s.invert_dir for s in steppers}
        self.motors = {s.oid: Motor() for s in steppers}
        self.records: list[Record] = []

    def execute(self, batch: bytes) -> None:
        for min_clock, req_clock, payload in unpack(batch):
            values = read_values(payload)
            name = self.names[values[0]]
            record = Record(min_clock, req_clock, name, values[1], values[2:], size=len(payload))
            getattr(self, f"_{name}")(record, self.motors[record.oid])
            self.records.append(record)

    def _queue_step(self, record: Record, motor: Motor) -> None:
        interval, count, add = record.values
        interval %= 1 << 32
        assert 1 <= count <= 65535
        assert -32768 <= add <= 32767
        assert motor.clock is not None, "queue_step before the first reset_step_clock"
        assert motor.direction is not None
        clock = motor.clock
        for i in range(count):
            assert 0 < interval < 1 << 32
            clock = (clock + interval) % (1 << 32)
            # Unwrapped beside what the host said: never more than 2^31 ticks off.
            known = motor.steps[-1][0] if i else record.req_clock
            offset = (clock - known) % (1 << 32)
            assert offset < 1 << 31
            motor.steps.append((known + offset, motor.direction))
            motor.intervals.append(interval)
            if i == 0:
                record.first = motor.steps[-1][0]
            interval += add
        motor.clock = clock
        motor.finish = record.finish = motor.steps[-1][0]

    def _set_next_step_dir(self, record: Record, motor: Motor) -> None:
        assert record.values[0] in {0, 1}
        direction = 1 if bool(record.values[0]) != self.invert[record.oid] else -1
        assert direction != motor.direction, "direction sent without a change"
        motor.direction = direction

    def _reset_step_clock(self, record: Record, motor: Motor) -> None:
        assert not motor.steps or record.min_clock > motor.finish
        motor.clock = record.values[0] % (1 << 32)

    def check_slots(self) -> int:
        """Receive everything as early as its min_clock allows; return the most slots ever in use."""
        held: list[int] = []
        now, most = 0, 0
        for record in self.records:
            now = max(now, record.min_clock)
            if record.name == "queue_step":
                held = [finish for finish in held if finish > now]
                held.append(record.finish)
                most = max(most, len(held))
        return most

    def framed_bytes(self) -> int:
        total, used = 0, 60
        for record in self.records:
            if used + record.size > 59:
                total, used = total + 5, 0
            total, used = total + record.size, used + record.size
        return total


# -------------------------------------------------------------------------------------------- the optimum


def fewest_segments(bands: Sequence[tuple[int, int]], clock: int) -> int:
    """Return the least number of segments that step inside BANDS, by trying every one from every clock.

    The first two clocks of a segment decide it, so trying all pairs tries all segments.
    """
    reachable, segments = {(0, clock)}, 0
    seen = set(reachable)
    while not any(i == len(bands) for i, _ in reachable):
        segments += 1
        following: set[tuple[int, int]] = set()
        for i, at in reachable:
            for first in range(bands[i][0], bands[i][1] + 1):
                following.add((i + 1, first))
                if i + 1 < len(bands):
                    for second in range(bands[i + 1][0], bands[i + 1][1] + 1):
                        _follow(bands, (i + 1, first), second - first, second - 2 * first + at, following)
        reachable = following - seen
        seen |= reachable
    return segments


def _follow(
    bands: Sequence[tuple[int, int]],
    at: tuple[int, int],
    interval: int,
    add: int,
    found: set[tuple[int, int]],
) -> None:
    i, clock = at
    if not -32768 <= add <= 32767:
        return
    while i < len(bands) and interval > 0:
        clock += interval
        if not bands[i][0] <= clock <= bands[i][1]:
            return
        i += 1
        found.add((i, clock))
        interval += add
