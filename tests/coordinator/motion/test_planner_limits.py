"""Limits not every machine has: speeds of X and Y, round work spaces; and what a change of tool changes."""

import math
from dataclasses import asdict, replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from coordinator.motion.planner.planner import FaultKind, FeedStatus
from coordinator.motion.specs import MotionLimits
from tests.coordinator.motion.planner_helpers import (
    LIMITS,
    check_invariants,
    flushed,
    homed_planner,
    joined,
    planned,
)

ROUND = replace(LIMITS, position_min=(-100, -100, 0), position_max=(100, 100, 100), max_radius=100)
RING = replace(ROUND, radius_min=10)
ROUNDING = 1 + 1e-12
coordinates = st.floats(-120, 120).map(lambda value: round(value, 3))


def test_x_and_y_have_their_own_limits_on_every_slope() -> None:
    limits = replace(LIMITS, max_x_velocity=100, max_x_accel=2000, max_y_velocity=50, max_y_accel=4000)
    lines = [b"G1 X125 Y125 F24000\n"]
    for degrees in range(0, 360, 7):
        x, y = (125 + 100 * turn(math.radians(degrees)) for turn in (math.cos, math.sin))
        lines.append(b"G1 X%.3f Y%.3f\nG1 X125 Y125\n" % (x, y))
    t = planned(homed_planner(limits), b"".join(lines))
    check_invariants(t, limits)
    ratio = np.abs(t["ratio"])
    bounds = (limits.max_x_velocity, limits.max_y_velocity), (limits.max_x_accel, limits.max_y_accel)
    for speeds, most in zip((t["cruise_v"], t["accel"]), bounds, strict=True):
        share = speeds[:, None] * ratio[:, :2] / most
        assert (share <= ROUNDING).all()
        # And no lower than that: one of the axes is at its limit, since the path's own is far above.
        np.testing.assert_allclose(share.max(axis=1), 1, rtol=1e-9)


@pytest.mark.parametrize("name", ["max_x_velocity", "max_x_accel", "max_y_velocity", "max_y_accel"])
def test_each_of_these_limits_stands_alone(name: str) -> None:
    limits = MotionLimits(**{**asdict(LIMITS), name: 30.0})
    t = planned(homed_planner(limits), b"G1 X100 Y50 F24000\n")
    free = planned(homed_planner(), b"G1 X100 Y50 F24000\n")
    axis, what = "xy".index(name[4]), "cruise_v" if name.endswith("velocity") else "accel"
    other = "accel" if what == "cruise_v" else "cruise_v"
    assert t[what][0] * t["ratio"][0, axis] == pytest.approx(30)
    assert t["accel"][0] == free["accel"][0] or what == "accel"
    assert t[other][0] <= free[other][0]


def test_moves_that_limits_slow_down_are_counted_by_limit_and_line() -> None:
    limits = replace(LIMITS, max_velocity=200, max_x_velocity=100, max_y_velocity=150, max_z_velocity=10)
    lines = (
        b"G1 X10 F6000", b"G1 X20 F9000", b"G1 X10 F7200", b"G1 Y10 F9000", b"G1 Y20 F9001", b"G1 Z1 F601",
        b"G1 X30 Y30 F12001", b"G1 X30.0000000000001 F90000", b"G1 F60000", b"G1 X31 Y31 E0.01 Z1 F3000",
    )  # fmt: skip
    planner = homed_planner(limits)
    planned(planner, b"\n".join(lines) + b"\n")
    first = planner.lines - len(lines)
    x, y, z = planner.slowed
    assert (x.limit, x.moves, x.first_line - first, x.worst_line - first) == ("max_x_velocity", 3, 2, 7)
    assert [x.asked_mm_s, x.allowed_mm_s] == pytest.approx([12001 / 60, 50 * 5**0.5])
    assert (y.limit, y.moves, y.first_line - first) == ("max_y_velocity", 1, 5)
    assert (z.limit, z.moves, z.first_line - first, z.worst_line) == ("max_z_velocity", 1, 6, z.first_line)


@given(st.lists(st.tuples(coordinates, coordinates), min_size=1, max_size=30))
def test_no_move_leaves_a_ring(points: list[tuple[float, float]]) -> None:
    planner = homed_planner(RING)
    planner.set_position((50, 0, 0, 0))
    done = [(50.0, 0.0)]
    for x, y in points:
        (x0, y0), share = done[-1], np.linspace(0, 1, 2001)
        way = np.hypot(x0 + share * (x - x0), y0 + share * (y - y0))
        status = planner.move({"X": x, "Y": y})
        if status is FeedStatus.LIMIT:
            kind = planner.fault.kind
            assert kind is not FaultKind.TOO_FAR or way[-1] > 100
            # The samples may miss the nearest point of a long way by this little.
            assert kind is not FaultKind.TOO_NEAR or way.min() < 10 + 1e-3
            assert planner.toolhead_position[:2] == done[-1]
        else:
            assert way.max() < 100 + 1e-6
            assert way.min() > 10 - 1e-6
            done.append((x, y))
    check_invariants(joined(flushed(planner)), RING)


@pytest.mark.parametrize(
    ("line", "sentence"),
    [
        (b"G1 X80 Y80", "the move ends 113.137 mm from the middle, more than 100 mm"),
        (b"G1 X-50 Y1", "the move passes the middle at 0.499975 mm, nearer than 10 mm"),
    ],
)
def test_refused_moves_say_how_far(line: bytes, sentence: str) -> None:
    planner = homed_planner(RING)
    planner.set_position((50, 0, 0, 0))
    assert planner.feed(line, 0, len(line), final=True).status is FeedStatus.LIMIT
    assert str(planner.fault).startswith(sentence)


def test_only_moves_that_print_have_pressure_advance() -> None:
    planner = homed_planner()
    planner.pressure_advance = 0.05
    text = b"M204 S1000\nG1 X10 E1 F6000\nG1 X20\nG1 X30 E0\nG1 E5\nG1 Z1 E5.01\nG1 X40 Z2 E5.3\n"
    feed = planner.feed(text, 0, len(text), final=True)
    assert feed.status is FeedStatus.NEED_DATA
    planner.pressure_advance = 0.02
    assert planner.move({"Y": 10, "E": 6}) is FeedStatus.NEED_DATA
    t = joined(flushed(planner))
    assert t["pressure_advance"].tolist() == [0.05, 0, 0, 0, 0, 0.05, 0.02]
    assert t["line"].tolist() == [2, 3, 4, 5, 6, 7, 8]


def test_a_range_and_an_extruder_that_change() -> None:
    planner = homed_planner()
    planner.set_range(0, 20, 30)
    assert planner.move({"X": 19}) is FeedStatus.LIMIT
    assert planner.move({"X": 25}) is FeedStatus.NEED_DATA
    planner.set_extruder_limits(replace(LIMITS, max_velocity=1, max_extrude_only_distance=5))
    assert planner.move({"E": 6}) is FeedStatus.LIMIT
    assert planner.fault.kind is FaultKind.EXTRUDE_LONG
    assert planner.max_velocity == LIMITS.max_velocity, "which is the machine's"
    with pytest.raises(ValueError, match="pressure advance"):
        planner.pressure_advance = -1
