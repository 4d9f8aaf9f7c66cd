"""Step generation over a bed that is no plane, for every kinematics, against the exact motion: every step."""

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from coordinator.motion.steps.errors import StepError
from coordinator.motion.steps.shapers import shaper_impulses
from coordinator.motion.steps.steps import StepGenerator
from coordinator.motion.steps.surface import Surface
from coordinator.verification.exact_bed import ExactBed
from coordinator.verification.exact_path import Setting
from tests.coordinator.motion.bed_cases import WITH_Z, SomeBed, across, bed, judge, over_bed, z_spec
from tests.coordinator.motion.exact_cases import AWAY, SETTING, spec_of, trapezoids
from tests.coordinator.motion.steps_harness import node_spec, stepper
from tests.coordinator.motion.steps_oracle import make_move
from tests.profiles import examples

SETTINGS = {"plain": Setting(), "shaped": SETTING}


@pytest.mark.parametrize("kind", ["z", "corexz", *WITH_Z])
@pytest.mark.parametrize("setting", SETTINGS)
def test_every_step_over_a_bed(kind: str, setting: str) -> None:
    spec = z_spec(kind, 0.0005 if kind == "z" else 0.00625)
    chosen = replace(SETTINGS[setting], smooth_s=0.0)
    assert judge(spec, over_bed(3), chosen, bed(7)) > 500


BEDS = st.builds(
    SomeBed,
    seed=st.integers(0, 2**32 - 1),
    slope=st.floats(-4, -1.9).map(lambda power: 10**power),
    spacing_mm=st.floats(3, 60),
    counts=st.tuples(st.integers(2, 7), st.integers(2, 7)),
    fades=st.booleans(),
)
SHAPERS = st.sampled_from((None, "zv", "mzv", "ei", "3hump_ei"))


@settings(max_examples=examples(8))
@given(some=BEDS, kind=st.sampled_from(("z", "z", "z", *WITH_Z)), shaper=SHAPERS, lift=st.booleans())
def test_every_step_over_any_bed(some: SomeBed, kind: str, shaper: str | None, *, lift: bool) -> None:
    """Also over nearly flat ones, where whole moves are passed without a look at each of their phases."""
    found = {} if shaper is None else {axis: shaper_impulses(shaper, 45.0, 0.1) for axis in "XY"}
    moves = over_bed(some.seed, lift=lift, count=60)
    judge(z_spec(kind, 0.0025), moves, Setting(found, 0.0), some.surface())


@pytest.mark.parametrize("seed", [1, 2])
def test_long_moves_over_many_patches(seed: int) -> None:
    spec = replace(spec_of("z"), step_distance=0.0005)
    surface = bed(seed, spacing_mm=7.0)
    nodes = np.tile(np.asarray(surface.nodes) / 3, (3, 3, 1)).tolist()
    fine = Surface(surface.origin_mm, (7.0 / 3, 5.6 / 3), nodes)
    assert judge(spec, across(seed), Setting(), fine) > 5000


def test_moves_from_the_edge() -> None:
    """They come back to it by a rounding error too far: beyond it the bed is level, in front of it not."""
    rng = np.random.default_rng(1)
    beyond = (float(np.nextafter(AWAY[0], 0)), float(np.nextafter(AWAY[1], 0)), *AWAY[2:])
    nodes = np.zeros((2, 2, 4))
    nodes[:, 1, 0], nodes[:, :, 1] = 0.4, 0.02
    spec, moves, t = z_spec("z", 0.0025), [], 1.0
    for _ in range(40):
        far = (AWAY[0] + rng.uniform(1, 15), AWAY[1] + rng.uniform(1, 15), AWAY[2], 0.0)
        for begin, end in ((AWAY, far), (far, beyond)):
            moves.append(make_move(t, begin, end, (0.0, 150.0, 0.0), 8000.0))
            t += moves[-1].total_s + rng.choice([0.0, 0.3])
    surface = Surface(AWAY[:2], (20.0, 20.0), nodes.tolist())
    assert judge(spec, trapezoids(moves), Setting(), surface) > 500


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
        ("nodes", np.zeros((1, 5, 4)).tolist()),
        ("nodes", np.full((3, 3, 4), math.inf).tolist()),
        ("nodes", np.random.default_rng(1).normal(0, 10, (3, 3, 4)).tolist()),  # a cliff
        ("fade_mm", (5.0, 2.0, 0.0)),
        ("fade_mm", (5.0, 5.01, 0.0)),  # faster than the bed is deep
    ],
)
def test_what_is_no_bed_is_refused(change: str, value: Any) -> None:
    good = bed(1)
    values = {name: getattr(good, name) for name in ("origin_mm", "spacing_mm", "fade_mm")}
    values["nodes"] = good.nodes.tolist()
    with pytest.raises(StepError, match="shape of the bed is refused"):
        Surface(**(values | {change: value}))


def test_z_and_e_of_one_stepper_are_refused() -> None:
    gen = StepGenerator([stepper(0, (0.0, 0.0, 1.0, 0.5), 0.01)], [node_spec()])
    with pytest.raises(StepError, match="both Z and E"):
        gen.set_surface(bed(1))
