"""Step generation of every kinematics, plain and shaped, against the exact motion: every single step."""

from typing import Any

import numpy as np
import pytest

from coordinator.motion.specs import StepperSpec
from coordinator.motion.steps.steps import MAX_ERROR_S, StepGenerator
from coordinator.verification.exact_path import Leg, Setting
from tests.coordinator.motion.exact_cases import AWAY, LINEAR, PARAMS, SETTING, chain, spec_of, trapezoids
from tests.coordinator.motion.exact_check import StepperProof, check
from tests.coordinator.motion.replay import Stream, replay
from tests.coordinator.motion.steps_harness import node_spec

MOVES = 150
CUT_S = 0.37
"""Steps are generated in pieces: what is held back over a border must not show."""
SETTINGS = {"plain": Setting(), "shaped": SETTING}


def generated(spec: StepperSpec, moves: Any, setting: Setting) -> Stream:
    node = node_spec(move_count=4096)
    gen: Any = StepGenerator([spec], [node], start=AWAY)
    if setting is not SETTINGS["plain"]:
        for axis, impulses in setting.shapers.items():
            gen.set_shaper("XYZ".index(axis), impulses)
        gen.set_smooth_time(0, setting.smooth_s)
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


@pytest.mark.parametrize("kind", [*LINEAR, *PARAMS])
@pytest.mark.parametrize("setting", SETTINGS)
@pytest.mark.parametrize("seed", [1, 2])
def test_every_step_is_where_the_exact_motion_has_it(kind: str, setting: str, seed: int) -> None:
    moves = trapezoids(chain(seed, MOVES), 0.05 if setting == "shaped" else 0.0)
    moves["pressure_advance"][MOVES // 2 :] *= 0.4
    moves["start"] += AWAY
    spec, chosen = spec_of(kind), SETTINGS[setting]
    stream = generated(spec, moves, chosen)
    proof = StepperProof([Leg(spec, AWAY, moves, chosen)])
    verdict = check(proof, stream, node_spec().clock_freq, MAX_ERROR_S)
    assert verdict.checked == verdict.emitted
    assert verdict.outside == 0, f"at {verdict.outside_s} s"
    assert verdict.position == verdict.wanted_position
    # Opposite steps closer than the pulses allow are left out in pairs, at a turn.
    assert verdict.wanted - verdict.emitted in range(0, 2 * MOVES, 2)
    assert verdict.emitted > 1000 or kind == "z"
