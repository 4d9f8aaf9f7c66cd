"""Step generation over a bed that is no plane, for every kinematics, against the exact motion: every step."""

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from coordinator.motion.specs import StepperSpec
from coordinator.motion.steps.errors import StepError
from coordinator.motion.steps.steps import MAX_ERROR_S, StepGenerator
from coordinator.motion.steps.surface import NO_FADE, Surface
from coordinator.verification.exact_bed import ExactBed
from coordinator.verification.exact_path import Leg, Setting
from tests.coordinator.motion.exact_cases import AWAY, PARAMS, SETTING, chain, spec_of, trapezoids
from tests.coordinator.motion.exact_check import StepperProof, check
from tests.coordinator.motion.replay import Stream, replay
from tests.coordinator.motion.steps_harness import node_spec, stepper
from tests.coordinator.motion.steps_oracle import make_move

MOVES = 150
CUT_S = 0.37
WITH_Z = [kind for kind in PARAMS if not kind.startswith("polar")]
SETTINGS = {"plain": Setting(), "shaped": SETTING}


def bed(seed: int, fade: tuple[float, float, float] = NO_FADE, *, spacing_mm: float = 7.0) -> Surface:
    """Return a bed around AWAY, smaller than what the moves reach."""
    rng = np.random.default_rng(seed)
    sizes = (0.015 * spacing_mm, 0.01, 0.01, 0.007 / spacing_mm)
    nodes = np.stack([rng.normal(0, size, (4, 5)) for size in sizes], axis=-1)
    return Surface((AWAY[0] - 14, AWAY[1] - 9), (spacing_mm, spacing_mm * 0.8), nodes, fade)


def over_bed(seed: int, *, lift: bool = False) -> Any:
    """Return moves over the bed; with LIFT, Z too goes up and down."""
    moves = trapezoids(chain(seed, MOVES))
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


@pytest.mark.parametrize("kind", ["z", "corexz", *WITH_Z])
@pytest.mark.parametrize("setting", SETTINGS)
def test_every_step_over_a_bed(kind: str, setting: str) -> None:
    spec = stepper(0, (1.0, 0.0, 1.0, 0.0), 0.00625) if kind == "corexz" else spec_of(kind)
    if kind == "z":
        spec = replace(spec, step_distance=0.0005)
    chosen = replace(SETTINGS[setting], smooth_s=0.0)
    assert judge(spec, over_bed(3), chosen, bed(7)) > 500


@pytest.mark.parametrize("seed", [1, 2])
def test_long_moves_over_many_patches(seed: int) -> None:
    spec = replace(spec_of("z"), step_distance=0.0005)
    surface = bed(seed, spacing_mm=7.0)
    fine = Surface(surface.origin_mm, (7.0 / 3, 5.6 / 3), np.tile(surface.nodes / 3, (3, 3, 1)))
    assert judge(spec, across(seed), Setting(), fine) > 5000


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_the_height_fades(seed: int) -> None:
    """Z goes through the range where it fades, up and down, over patches that a move crosses many of."""
    spec = replace(spec_of("z"), step_distance=0.0005)
    fade = (AWAY[2] - 1.0, AWAY[2] + 1.5, 0.05)
    assert judge(spec, over_bed(seed, lift=True), Setting(), bed(seed, fade, spacing_mm=3.0)) > 500


def test_taking_up_and_clearing_a_surface_moves_nothing() -> None:
    spec, node = replace(spec_of("z"), step_distance=0.0005), node_spec()
    gen = StepGenerator([spec], [node], start=AWAY)
    surface = bed(5, (25.0, 30.0, 0.02))
    exact = ExactBed(surface)
    z = gen.set_surface(surface)
    x, y, motor_z = (np.array([v]) for v in AWAY[:3])
    assert exact.motor_z(x, y, np.array([z]))[0] == pytest.approx(motor_z[0], abs=1e-9)
    assert z != AWAY[2]
    assert gen.set_surface(None) == pytest.approx(AWAY[2], abs=1e-9)
    assert gen.generate(1.0, flush=True)
    assert not gen.take_batch(0)
    assert gen.position(0) == 0


@pytest.mark.parametrize(
    ("change", "value"),
    [
        ("spacing_mm", (0.01, 5.0)),
        ("origin_mm", (math.nan, 0.0)),
        ("nodes", np.zeros((1, 5, 4))),
        ("nodes", np.full((3, 3, 4), math.inf)),
        ("nodes", np.random.default_rng(1).normal(0, 10, (3, 3, 4))),  # a cliff
        ("fade_mm", (5.0, 2.0, 0.0)),
        ("fade_mm", (5.0, 5.01, 0.0)),  # faster than the bed is deep
    ],
)
def test_what_is_no_bed_is_refused(change: str, value: Any) -> None:
    good = bed(1)
    values = {name: getattr(good, name) for name in ("origin_mm", "spacing_mm", "nodes", "fade_mm")}
    with pytest.raises(StepError, match="shape of the bed is refused"):
        Surface(**(values | {change: value}))


def test_z_and_e_of_one_stepper_are_refused() -> None:
    gen = StepGenerator([stepper(0, (0.0, 0.0, 1.0, 0.5), 0.01)], [node_spec()])
    with pytest.raises(StepError, match="both Z and E"):
        gen.set_surface(bed(1))
