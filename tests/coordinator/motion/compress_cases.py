"""Small seeded motions that tell good compression from bad, and what the engine makes of them.

Five kinds: a cruise at a fractional interval, ramps, moves of changing speed in a row, the motor of a corexy
machine along a curve of short segments, and an extruder whose flow jumps at every joint.
"""

import json
import math
import random
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

from coordinator.motion.specs import NodeStreamSpec, StepperSpec
from tests.coordinator.motion.compress_oracle import Problem, optimum, payload_bytes
from tests.coordinator.motion.steps_harness import MAX_ERROR_S, ORIGIN, Run
from tests.coordinator.motion.steps_oracle import Move, Position, Record, Step, make_move, step_times

OPTIMA = Path(__file__).parents[2] / "data" / "compress_optima.json"
"""name -> [start clock, least queue_steps, least bytes of them]; `python -m` this module writes it."""
SEEDS = 50
NOISE_TICKS = 1e-3
"""By how much the band of the oracle is wider: the step times of two programs differ by less."""
DISTANCE = 0.01
PULSE_S = 2e-6
PREFIX = 2
"""Bytes of a queue_step before its values: id and oid."""
FREQUENCIES = (500_000, 1_000_000, 1_000_000, 2_000_000, 4_000_000, 8_000_000)
"""Ticks/s; low, so that a band has few ticks."""
STEPS_MIN, STEPS_MAX = 20, 60


Weights = tuple[float, float, float, float]
Motion = tuple[list[Move], Weights]
X_ONLY = (1.0, 0.0, 0.0, 0.0)


@dataclass(frozen=True)
class Case:
    """One motion of one stepper."""

    name: str
    freq: int
    moves: tuple[Move, ...]
    weights: Weights

    @property
    def kind(self) -> str:
        return self.name.split()[0]

    @property
    def spec(self) -> StepperSpec:
        return StepperSpec("s", 0, 0, self.weights, DISTANCE, False, PULSE_S)

    @cached_property
    def steps(self) -> list[Step]:
        return step_times(self.spec, self.freq, self.moves, ORIGIN, MAX_ERROR_S)

    def problem(self, start: int) -> Problem:
        """Return what the oracle has to solve when the first segment counts from clock START."""
        bands = []
        for step in self.steps:
            at, reach = step.time * self.freq, step.band_s * self.freq + NOISE_TICKS
            bands.append((math.ceil(at - reach), math.floor(at + reach)))
        turns = (i for i in range(1, len(bands)) if self.steps[i].direction != self.steps[i - 1].direction)
        return Problem(bands, start, max(math.ceil(2 * PULSE_S * self.freq), 1), frozenset(turns))


@dataclass(frozen=True)
class Yield:
    """What compression made of a case."""

    start: int
    """Clock that the only reset_step_clock set."""
    commands: int
    payload: int
    """Bytes of all queue_step."""


def compress(case: Case) -> Yield:
    """Run the engine on CASE."""
    run = Run([case.spec], [NodeStreamSpec("n", case.freq, 4096, 21, 22, 23)])
    run.play(case.moves)
    records: list[Record] = run.nodes[0].records
    resets = [r.values[0] for r in records if r.name == "reset_step_clock"]
    queued = [r for r in records if r.name == "queue_step"]
    assert len(resets) == 1
    assert sum(r.values[1] for r in queued) == len(case.steps)
    return Yield(resets[0], len(queued), sum(r.size for r in queued))


def cases() -> Iterator[Case]:
    """Yield the whole set, always the same."""
    for kind in _MAKERS:
        for seed in range(SEEDS):
            yield _case(kind, seed)


def _case(kind: str, seed: int) -> Case:
    rng = random.Random(f"{kind} {seed}")
    freq = rng.choice(FREQUENCIES)
    # At top speed half the distance between steps is from half to four times the widest band.
    speed = DISTANCE / (MAX_ERROR_S * math.exp(rng.uniform(math.log(1.0), math.log(8.0))))
    while True:
        moves, weights = _MAKERS[kind](rng, speed)
        case = Case(f"{kind} {seed}", freq, tuple(moves), weights)
        if STEPS_MIN <= len(case.steps) <= STEPS_MAX:
            return case


def _along(joint: float, pieces: list[tuple[float, float, float]], accel: float) -> list[Move]:
    """Return moves along X that begin at speed JOINT; PIECES are (length, top speed, end speed)."""
    moves: list[Move] = []
    t, at = 1.0, 0.0
    for length, top, end in pieces:
        move = make_move(t, (at, 0.0, 0.0, 0.0), (at + length, 0.0, 0.0, 0.0), (joint, top, end), accel)
        moves.append(move)
        t, at = t + move.total_s, at + length
        joint = move.cruise_v - move.accel * move.seconds[2]
    return moves


def _cruise(rng: random.Random, speed: float) -> Motion:
    """Constant speed, of an interval that is no whole number of ticks."""
    length = DISTANCE * rng.uniform(40, STEPS_MAX)
    return [Move(1.0, (0.0, length / speed, 0.0), speed, speed, 0.0, ORIGIN, (1.0, 0.0, 0.0, 0.0))], X_ONLY


def _ramps(rng: random.Random, speed: float) -> Motion:
    """From rest to a top speed and back, with or without a cruise between."""
    length = DISTANCE * rng.uniform(40, STEPS_MAX)
    accel = speed * speed / (length * rng.uniform(0.5, 1.5))
    return _along(0.0, [(length, speed, rng.choice([0.0, 0.3 * speed]))], accel), X_ONLY


def _joints(rng: random.Random, speed: float) -> Motion:
    """Moves in a row, each with its own top speed, joined at other speeds."""
    count = rng.randint(3, 6)
    pieces = [
        (
            DISTANCE * rng.uniform(10, 100) / count,
            speed * rng.uniform(0.4, 1.0),
            speed * rng.uniform(0.4, 1.0),
        )
        for _ in range(count)
    ]
    return _along(speed * rng.random(), pieces, speed * speed / (DISTANCE * rng.uniform(10, 60))), X_ONLY


def _corexy(rng: random.Random, speed: float) -> Motion:
    """One motor of a corexy machine along a polygon, at constant speed: its rate jumps at every corner."""
    heading, bend = rng.uniform(-0.5, 1.4), rng.uniform(-0.15, 0.15)
    side = DISTANCE * rng.uniform(3, 12)
    moves: list[Move] = []
    t, x, y = 1.0, 0.0, 0.0
    for _ in range(int(50 * DISTANCE / side) + 1):
        ratio: Position = (math.cos(heading), math.sin(heading), 0.0, 0.0)
        moves.append(Move(t, (0.0, side / speed, 0.0), speed, speed, 0.0, (x, y, 0.0, 0.0), ratio))
        t, x, y, heading = t + side / speed, x + side * ratio[0], y + side * ratio[1], heading + bend
    return moves, (1.0, 1.0, 0.0, 0.0)


def _extruder(rng: random.Random, speed: float) -> Motion:
    """Flow that jumps by a few percent at every joint, in moves of changing path speed, with a retraction."""
    flow, moves, t, x, e = 0.05, [], 1.0, 0.0, 0.0
    path, joint = speed / flow, 0.0
    accel = path * path / (DISTANCE / flow * rng.uniform(20, 100))
    for _ in range(rng.randint(2, 5)):
        ratio = flow * rng.uniform(0.9, 1.1)
        length = DISTANCE / flow * rng.uniform(4, 20)
        end: Position = (x + length, 0.0, 0.0, e + length * ratio)
        move = make_move(t, (x, 0.0, 0.0, e), end, (joint, path, path * rng.uniform(0.3, 1.0)), accel)
        moves.append(move)
        t, x, e = t + move.total_s, x + length, end[3]
        joint = move.cruise_v - move.accel * move.seconds[2]
    back = DISTANCE * rng.uniform(5, 10)
    moves.append(
        make_move(t, (x, 0.0, 0.0, e), (x, 0.0, 0.0, e - back), (0.0, speed, 0.0), speed * speed / back)
    )
    return moves, (0.0, 0.0, 0.0, 1.0)


_MAKERS = {"cruise": _cruise, "ramps": _ramps, "joints": _joints, "corexy": _corexy, "extruder": _extruder}
KINDS = tuple(_MAKERS)


def main() -> None:
    """Solve the whole set and write OPTIMA; takes some minutes."""
    optima = {}
    for case in cases():
        problem = case.problem(compress(case).start)
        optima[case.name] = [problem.start, optimum(problem), optimum(problem, payload_bytes(PREFIX))]
    lines = (f"{json.dumps(name)}: {json.dumps(row)}" for name, row in optima.items())
    OPTIMA.write_text("{\n" + ",\n".join(lines) + "\n}\n")


if __name__ == "__main__":
    main()
