"""Motions that rest and turn at half steps: the emitted steps are those of the exact motion, and no more."""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from coordinator.motion.specs import StepperSpec
from coordinator.motion.steps.steps import StepGenerator
from coordinator.verification.exact_path import Leg, Setting, follow
from coordinator.verification.expected_curved import expected_curved
from coordinator.verification.half_steps import TIE_STEPS
from tests.coordinator.motion.exact_cases import AWAY, PARAMS, SHAPER, spec_of, trapezoids
from tests.coordinator.motion.replay import Stream, replay
from tests.coordinator.motion.steps_harness import node_spec
from tests.coordinator.motion.steps_oracle import Move, Position, make_move
from tests.profiles import is_full

MOVES = 14
MAX_ERROR_S = 2e-7
"""Finer than what is shipped: so that the distances of steps are those of the motion."""
CUT_S = 0.11
PROGRAMS = 10_000 if is_full() else 60


def _towards(anchor: tuple[float, ...]) -> Position:
    x, y, z = (a - b for a, b in zip(AWAY[:3], anchor, strict=True))
    length = math.hypot(x, y, z)
    return (x / length, y / length, z / length, 0.0)


LINES: dict[str, Position] = {
    "x": (1.0, 0.0, 0.0, 0.0),
    "corexy": (0.0, -1.0, 0.0, 0.0),
    "z": (0.0, 0.0, 1.0, 0.0),
    "extruder": (0.0, 0.0, 0.0, 1.0),
    "delta": (0.0, 0.0, 1.0, 0.0),
    "deltesian": (0.0, 0.0, 1.0, 0.0),
    "polar_radius": (0.8, 0.6, 0.0, 0.0),
    "winch": _towards(PARAMS["winch"]),
}
"""By kind of stepper: along this line from AWAY it follows the head mm by mm."""
SHAPED = {"X": SHAPER, "Y": ((0.5, -0.004), (0.5, 0.004))}
SETTINGS = (Setting(), Setting(SHAPED), Setting({}, 0.04), Setting(SHAPED, 0.02))


@dataclass(frozen=True)
class Program:
    """A motion between half steps, and the stepper that makes it."""

    spec: StepperSpec
    moves: NDArray[np.void]
    setting: Setting


def program(seed: int) -> Program:
    """Return a random program: moves by halves of steps, on and back, with rests of 0 s to 0.3 s between."""
    rng = np.random.default_rng(seed)
    kinds = list(LINES)
    kind = kinds[seed % len(kinds)]
    spec, line = spec_of(kind), LINES[kind]
    moves: list[Move] = []
    t, at = 1.0, 0.0
    for _ in range(MOVES):
        steps = int(rng.choice([1, 3, 40, 301])) + 0.5 * int(rng.integers(0, 2))
        to = at + float(rng.choice([-1, 1])) * steps
        end, start = (_place(line, spec.step_distance * u) for u in (to, at))
        moves.append(make_move(t, start, end, (0.0, float(rng.uniform(1, 40)), 0.0), 1500.0))
        t, at = t + moves[-1].total_s + float(rng.choice([0.0, 1e-5, 1e-3, 0.3])), to
    rows = trapezoids(moves)
    rows["pressure_advance"] = rng.choice([0.0, 0.01, 0.06], MOVES)
    return Program(spec, rows, SETTINGS[int(rng.integers(len(SETTINGS)))])


def _place(line: Position, mm: float) -> Position:
    x, y, z, e = (a + r * mm for a, r in zip(AWAY, line, strict=True))
    return (x, y, z, e)


def generated(of: Program) -> Stream:
    node = node_spec(move_count=4096)
    gen: Any = StepGenerator([of.spec], [node], start=AWAY, max_error_s=MAX_ERROR_S)
    for axis, impulses in of.setting.shapers.items():
        gen.set_shaper("XYZ".index(axis), impulses)
    if of.setting.smooth_s:
        gen.set_smooth_time(0, of.setting.smooth_s)
    assert gen.append(of.moves, len(of.moves)) == len(of.moves)
    last = of.moves[-1]
    end = float(last["print_time"] + last["accel_s"] + last["cruise_s"] + last["decel_s"]) + 0.5
    batch = bytearray()
    for until in [*np.arange(1.0, end, CUT_S), end]:
        while not gen.generate(float(until), flush=until == end):
            batch += gen.take_batch(0)
        while piece := gen.take_batch(0):
            batch += piece
    return replay(bytes(batch), node, [of.spec])[of.spec.name]


def check(of: Program) -> int:
    """Compare what is emitted with the exact motion; return the pairs of opposite steps."""
    leg = Leg(of.spec, AWAY, of.moves, of.setting)
    freq = node_spec().clock_freq
    wanted = list(expected_curved([leg], freq))
    times = np.concatenate([w.print_time for w in wanted])
    directions = np.concatenate([w.direction for w in wanted])
    clock, done, _ = generated(of).expand()
    assert done.tolist() == directions.tolist()
    if len(times) < 2:
        return 0
    emitted = clock / freq
    needed = float(np.diff(times).min())
    assert float(np.diff(emitted).min()) >= 0.99 * needed - 2 * MAX_ERROR_S
    _, turns, u, _ = next(follow([leg]))
    position = np.cumsum(directions, dtype=np.int64)
    pairs = np.flatnonzero(directions[1:] != directions[:-1])
    for i in pairs:
        boundary = position[i] - directions[i] / 2
        between = (turns >= times[i] - 1e-9) & (turns <= times[i + 1] + 1e-9)
        beyond = (u[between] - boundary) * directions[i]
        assert beyond.max() > TIE_STEPS, f"a needless pair of steps at {times[i]} s"
    return len(pairs)


@pytest.mark.parametrize("part", range(4))
def test_no_step_is_made_that_the_motion_does_not_need(part: int) -> None:
    pairs = sum(check(program(seed)) for seed in range(part, PROGRAMS, 4))
    assert pairs > PROGRAMS / 4


def test_a_turn_in_the_very_middle_of_a_piece_is_a_turn() -> None:
    """Pressure advance that begins as it ends: the slope is exactly 0 where its middle is sampled."""
    assert check(program(7099)) > 0
