"""Beds, moves over them, and a comparison of every step with the exact motion, for step generation."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest

from coordinator.motion.specs import StepperSpec
from coordinator.motion.steps.steps import MAX_ERROR_S, StepGenerator
from coordinator.motion.steps.surface import NO_FADE, Surface
from coordinator.verification.exact_bed import ExactBed
from coordinator.verification.exact_path import Leg, Setting
from tests.coordinator.motion.exact_cases import AWAY, PARAMS, chain, spec_of, trapezoids
from tests.coordinator.motion.exact_check import StepperProof, check
from tests.coordinator.motion.replay import Stream, replay
from tests.coordinator.motion.steps_harness import node_spec, stepper
from tests.coordinator.motion.steps_oracle import make_move

MOVES = 150
CUT_S = 0.37
WITH_Z = [kind for kind in PARAMS if not kind.startswith("polar")]


def bed(seed: int, fade: tuple[float, float, float] = NO_FADE, *, spacing_mm: float = 7.0) -> Surface:
    """Return a bed around AWAY, smaller than what the moves reach."""
    rng = np.random.default_rng(seed)
    sizes = (0.015 * spacing_mm, 0.01, 0.01, 0.007 / spacing_mm)
    nodes = np.stack([rng.normal(0, size, (4, 5)) for size in sizes], axis=-1)
    return Surface((AWAY[0] - 14, AWAY[1] - 9), (spacing_mm, spacing_mm * 0.8), nodes.tolist(), fade)


@dataclass(frozen=True, slots=True)
class SomeBed:
    """A bed around AWAY of any size and steepness, mostly legal: a steep one is made flatter."""

    seed: int
    slope: float
    """About how steep, mm per mm."""
    spacing_mm: float
    counts: tuple[int, int]
    fades: bool

    def surface(self) -> Surface:
        """Return it."""
        rng = np.random.default_rng(self.seed)
        step, (columns, rows) = self.spacing_mm, self.counts
        sizes = (self.slope * step, self.slope, self.slope, self.slope / step)
        nodes = np.stack([rng.normal(0, size, (rows, columns)) for size in sizes], axis=-1)
        corner = (
            AWAY[0] - rng.uniform(0, 1) * step * columns,
            AWAY[1] - rng.uniform(0, 1) * step * rows,
        )
        fade = (
            (AWAY[2] - 1.0, AWAY[2] + 1.5 + 20 * self.slope * step, 0.05 * self.slope)
            if self.fades
            else NO_FADE
        )
        return Surface(corner, (step, step), nodes.tolist(), fade)


def over_bed(seed: int, *, lift: bool = False, count: int = MOVES) -> Any:
    """Return moves over the bed; with LIFT, Z too goes up and down."""
    moves = trapezoids(chain(seed, count))
    moves["start"] += AWAY
    if lift:
        z = AWAY[2]
        rng = np.random.default_rng(seed)
        for move in moves:
            way = (
                (move["start_v"] + 0.5 * move["accel"] * move["accel_s"]) * move["accel_s"]
                + move["cruise_v"] * move["cruise_s"]
                + (move["cruise_v"] - 0.5 * move["accel"] * move["decel_s"]) * move["decel_s"]
            )
            move["start"][2] = z
            move["ratio"][2] = rng.choice([0.0, 0.1, -0.1])
            z += move["ratio"][2] * way
    return moves


def across(seed: int, count: int = 40) -> Any:
    """Return long moves from rest to rest inside the bed: Z turns several times in a cruise."""
    rng = np.random.default_rng(seed)
    moves, t, at = [], 1.0, AWAY
    for _ in range(count):
        end = (AWAY[0] + rng.uniform(-14, 14), AWAY[1] + rng.uniform(-9, 7.8), AWAY[2], 0.0)
        moves.append(make_move(t, at, end, (0.0, float(rng.uniform(50, 400)), 0.0), 8000.0))
        t, at = t + moves[-1].total_s + rng.choice([0.0, 0.01, 0.3]), end
    return trapezoids(moves)


def generated(spec: StepperSpec, moves: Any, setting: Setting, surface: Surface) -> Stream:
    node = node_spec(move_count=4096)
    x, y, z = (float(v) for v in AWAY[:3])
    bed_z = float(ExactBed(surface).motor_z(np.array([x]), np.array([y]), np.array([z]))[0])
    gen: Any = StepGenerator([spec], [node], start=(x, y, bed_z, 0.0))
    for axis, impulses in setting.shapers.items():
        gen.set_shaper("XYZ".index(axis), impulses)
    assert gen.set_surface(surface) == pytest.approx(z, abs=1e-12)
    assert gen.append(moves, len(moves)) == len(moves)
    end = float(moves[-1]["print_time"]) + 1.0
    batch = bytearray()
    for until in [*np.arange(1.0, end - 0.5, CUT_S), end]:
        done = False
        while not done:
            done = gen.generate(float(until), flush=until == end)
            while piece := gen.take_batch(0):
                batch += piece
    return replay(bytes(batch), node, [spec])[spec.name]


def judge(spec: StepperSpec, moves: Any, setting: Setting, surface: Surface) -> int:
    """Compare every step; return how many there are."""
    stream = generated(spec, moves, setting, surface)
    exact = replace(setting, bed=ExactBed(surface))
    verdict = check(
        StepperProof([Leg(spec, AWAY, moves, exact)]), stream, node_spec().clock_freq, MAX_ERROR_S
    )
    assert verdict.checked == verdict.emitted
    assert verdict.outside == 0, f"at {verdict.outside_s} s"
    assert verdict.position == verdict.wanted_position
    assert verdict.wanted - verdict.emitted in range(0, 4 * MOVES, 2)
    return verdict.emitted


def z_spec(kind: str, step_mm: float = 0.00625) -> StepperSpec:
    """Return a stepper that Z moves, alone or with others."""
    if kind == "corexz":
        return stepper(0, (1.0, 0.0, 1.0, 0.0), step_mm)
    spec = spec_of(kind)
    return replace(spec, step_distance=step_mm) if kind == "z" else spec
