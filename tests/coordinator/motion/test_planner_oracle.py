"""The look-ahead against its slow twin: speeds, durations, positions."""

import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from coordinator.motion.planner.planner import Planner
from coordinator.motion.specs import MotionLimits
from tests.coordinator.motion.planner_helpers import (
    LIMITS,
    Array,
    check_invariants,
    drain,
    end_speeds,
    flushed,
    homed_planner,
    lengths,
    planned,
    real_file,
)
from tests.coordinator.motion.planner_oracle import Language, plan
from tests.profiles import examples


def compare(t: Array, language: Language) -> None:
    """T must be what the twin makes of the same program."""
    profiles = plan(language.moves)
    assert len(t) == len(profiles)
    if not profiles:
        return
    start_v, cruise_v, end_v, duration = np.array(profiles).T
    # A reversal of a tiny move has a sine of rounding noise, and the speed there is that of its root.
    np.testing.assert_allclose(t["start_v"], start_v, rtol=1e-6, atol=1e-4)
    np.testing.assert_allclose(t["cruise_v"], cruise_v, rtol=1e-6, atol=1e-4)
    np.testing.assert_allclose(end_speeds(t), end_v, rtol=1e-6, atol=1e-4)
    np.testing.assert_allclose(t["accel_s"] + t["cruise_s"] + t["decel_s"], duration, rtol=1e-6, atol=1e-7)
    np.testing.assert_allclose(t["start"], [m.start for m in language.moves], rtol=0, atol=1e-9)
    np.testing.assert_allclose(lengths(t), [m.length for m in language.moves], rtol=1e-9, atol=1e-11)
    np.testing.assert_allclose(t["ratio"], [m.ratio for m in language.moves], rtol=0, atol=1e-9)


# Places on coarse and fine grids: straight runs, reversals, right angles and tiny moves all occur.
PLACE = st.one_of(
    st.integers(0, 5).map(float),
    st.integers(0, 250).map(float),
    st.integers(0, 250_000).map(lambda i: i / 1000),
)
STEP = st.sampled_from([-1.0, -0.1, -0.013, -0.001, 0.001, 0.004, 0.1, 0.3, 1.0, 7.0])


@st.composite
def programs(draw: st.DrawFn) -> list[str]:
    at = [100.0, 100.0, 10.0]
    lines = ["M83", "G1 X100 Y100 Z10 F6000"]
    for _ in range(draw(st.integers(1, 60))):
        kind = draw(st.sampled_from(["jump", "step", "step", "step", "run", "z", "e", "accel", "speed"]))
        if kind == "e":
            lines.append(f"G1 E{draw(st.sampled_from([-2, -0.6, 0.6, 2]))}")
        elif kind == "accel":
            lines.append(
                f"M204 {draw(st.sampled_from('SPT'))}{draw(st.sampled_from([500, 2000, 5000, 10000]))}"
            )
        elif kind == "speed":
            lines.append(f"G1 F{draw(st.sampled_from([60, 600, 4800, 12000, 18000]))}")
        else:
            extrusion = draw(st.sampled_from(["", " E0.02", " E0.004", " E-0.1"]))
            for _ in range(draw(st.integers(2, 12)) if kind == "run" else 1):
                if kind == "jump":
                    at[0], at[1] = draw(PLACE), draw(PLACE)
                elif kind == "z":
                    at[2] = min(max(at[2] + draw(STEP), 0), 250)
                else:
                    at[0] = round(min(max(at[0] + draw(STEP), 0), 250), 3)
                    at[1] = round(min(max(at[1] + draw(STEP), 0), 250), 3)
                lines.append(f"G1 X{at[0]:.3f} Y{at[1]:.3f} Z{at[2]:.3f}{extrusion}")
    return lines


LIMIT_SETS = st.builds(
    lambda ratio, scv, icv: dataclasses.replace(
        LIMITS,
        minimum_cruise_ratio=ratio,
        square_corner_velocity=scv,
        instantaneous_corner_velocity=icv,
        max_extrude_ratio=30,
    ),
    st.sampled_from([0.0, 0.5, 0.9]),
    st.sampled_from([0.0, 5.0, 20.0]),
    st.sampled_from([0.0, 1.0, 10.0]),
)


def run(planner: Planner, lines: list[str]) -> Array:
    """Feed LINES, acting on M83 and M204 as the interpreter would."""
    pieces = []
    text = b""
    for line in lines:
        if line.startswith("M"):
            feed = planner.feed(text, 0, len(text), final=True)
            assert feed.offset == len(text), planner.fault
            text = b""
            if line.startswith("M204"):
                planner.set_accel_words({line[5]: float(line[6:])})
            else:
                planner.relative_extrusion = line == "M83"
        else:
            text += line.encode() + b"\n"
    pieces.append(planned(planner, text))
    return np.concatenate(pieces)


@settings(max_examples=examples(100))
@given(programs(), LIMIT_SETS)
def test_random_programs(lines: list[str], limits: MotionLimits) -> None:
    planner = homed_planner(limits)
    language = Language(limits, (0, 0, 0, 0))
    for line in lines:
        language.line(line)
    t = run(planner, lines)
    assert planner.moves_overflowed == 0
    compare(t, language)
    check_invariants(t, limits, end=planner.toolhead_position)


@pytest.mark.parametrize("name", ["text_cube.gcode", "vase.gcode", "circles01.gcode"])
def test_real_files(name: str) -> None:
    lines = real_file(name).decode().splitlines()[:3000]
    planner = homed_planner()
    language = Language(LIMITS, (0, 0, 0, 0))
    pieces = []
    for line in lines:
        text = line.encode() + b"\n"
        if planner.feed(text, 0, len(text), final=False).offset == len(text):
            language.line(line)
        elif line.split(" ")[0] in {"G92", "M82", "M83", "M204"}:
            language.line(line)
            planner.accel = language.accel["T"]
            planner.set_accel_words({"P": language.accel["P"]})
            planner.relative_extrusion = language.relative_e
            if line.startswith("G92"):
                planner.set_gcode_position({"E": 0.0})
        pieces += drain(planner)
    t = np.concatenate(pieces + flushed(planner))
    compare(t, language)
    check_invariants(t, end=planner.toolhead_position)
