"""Arcs: each piece near the true arc, within its length; ends exact, in all planes, written both ways."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from coordinator.motion.planner.language import ARC_DEVIATION_MM, ARC_PIECE_MM, ArcFault, Plane
from coordinator.motion.planner.planner import FeedStatus, Planner
from tests.coordinator.motion.planner_helpers import drain, flushed, homed_planner, joined
from tests.profiles import examples

PLANES = {"G17": (Plane.XY, 0, 1, "IJ"), "G18": (Plane.ZX, 2, 0, "KI"), "G19": (Plane.YZ, 1, 2, "JK")}
START = (100.0, 110.0, 120.0)


def corners(planner: Planner, line: str) -> np.ndarray:
    """Plan one line and return the corners of the moves it became: X Y Z E, the start first."""
    start = planner.toolhead_position
    pieces, text, offset = [], line.encode() + b"\n", 0
    while (feed := planner.feed(text, offset, len(text), final=True)).status is FeedStatus.FULL:
        pieces += drain(planner)
        offset = feed.offset
    assert feed.status is FeedStatus.NEED_DATA, (feed, planner.fault)
    moves = joined([*pieces, *flushed(planner)])
    ends = [np.array(start)]
    for move in moves:
        cruise = move["cruise_v"]
        length = (move["start_v"] + cruise) / 2 * move["accel_s"] + cruise * move["cruise_s"]
        length += (cruise * move["decel_s"]) - move["accel"] * move["decel_s"] ** 2 / 2
        ends.append(move["start"] + move["ratio"] * length)
    return np.array(ends)


def at_start(plane: Plane = Plane.XY) -> Planner:
    planner = homed_planner()
    planner.set_position((*START, 0.0))
    planner.plane = plane
    return planner


@settings(max_examples=examples(150))
@given(
    code=st.sampled_from(sorted(PLANES)),
    clockwise=st.booleans(),
    radius=st.floats(0.01, 48),
    begin=st.floats(0, 2 * math.pi),
    sweep=st.floats(0.02, 2 * math.pi - 0.02),
    climb=st.floats(-20, 20),
    by_radius=st.booleans(),
)
def test_an_arc_is_a_polygon_near_it(  # noqa: PLR0917
    code: str,
    clockwise: bool,
    radius: float,
    begin: float,
    sweep: float,
    climb: float,
    by_radius: bool,
) -> None:
    plane, a, b, letters = PLANES[code]
    turn = -sweep if clockwise else sweep
    center = np.array([START[a] - radius * math.cos(begin), START[b] - radius * math.sin(begin)])
    end = list(START)
    end[a] = center[0] + radius * math.cos(begin + turn)
    end[b] = center[1] + radius * math.sin(begin + turn)
    end[3 - a - b] += climb
    words = [f"{axis}{value:.9f}" for axis, value in zip("XYZ", end, strict=True)]
    if by_radius:
        if min(sweep, abs(sweep - math.pi)) < 0.05 or radius < 0.1:  # there the radius says little
            return
        words.append(f"R{radius if sweep < math.pi else -radius:.9f}")
    else:
        words += [
            f"{letter}{c - START[axis]:.9f}" for letter, c, axis in zip(letters, center, (a, b), strict=True)
        ]
    planner = at_start(plane)
    found = corners(planner, f"G{2 if clockwise else 3} {' '.join(words)} E0.001 F6000")
    assert planner.toolhead_position == pytest.approx((*end, 0.001), abs=1e-8)
    rounding = 1e-6 / (1.0 if not by_radius else min(1.0, abs(math.sin(sweep / 2)) + 1e-3, radius))
    distance = np.hypot(found[:, a] - center[0], found[:, b] - center[1])
    assert np.abs(distance - radius).max() < rounding + 1e-6
    steps = np.hypot(np.diff(found[:, a]), np.diff(found[:, b]))
    assert steps.max() <= ARC_PIECE_MM + 1e-9
    middles = (found[1:] + found[:-1]) / 2
    inside = radius - np.hypot(middles[:, a] - center[0], middles[:, b] - center[1])
    assert inside.max() <= ARC_DEVIATION_MM + rounding
    # It goes the right way round, as far as it should, and climbs and extrudes evenly.
    angles = np.unwrap(np.arctan2(found[:, b] - center[1], found[:, a] - center[0]))
    assert angles[-1] - angles[0] == pytest.approx(turn, abs=rounding / radius + 1e-3)
    even = np.linspace(0, 1, len(found))
    assert found[:, 3 - a - b] == pytest.approx(START[3 - a - b] + climb * even, abs=1e-6)
    assert found[:, 3] == pytest.approx(0.001 * even, abs=1e-9)


@pytest.mark.parametrize(("code", "turn"), [("G2", -1), ("G3", 1)])
def test_an_end_at_its_start_is_a_full_circle(code: str, turn: int) -> None:
    planner = at_start()
    found = corners(planner, f"{code} I10 Z121 F6000")
    assert len(found) > 60
    angles = np.unwrap(np.arctan2(found[:, 1] - 110, found[:, 0] - 110))
    assert angles[-1] - angles[0] == pytest.approx(turn * 2 * math.pi)
    assert planner.toolhead_position == (100.0, 110.0, 121.0, 0.0)


def test_arcs_go_by_the_modes() -> None:
    planner = at_start()
    planner.relative, planner.unit_mm = True, 25.4
    planner.extrude_factor = 0.5
    corners(planner, "G3 X1 Y1 J1 E1 F60")
    assert planner.toolhead_position == pytest.approx((125.4, 135.4, 120.0, 12.7))
    assert planner.speed_mm_s == pytest.approx(25.4)
    planner.relative = False
    planner.set_gcode_position({"X": 0, "Y": 0})
    corners(planner, "G2 X1 Y-1 J-1")
    assert planner.toolhead_position == pytest.approx((150.8, 110.0, 120.0, 12.7))


def test_the_precision_can_be_chosen() -> None:
    planner = at_start()
    planner.set_arc_precision(0.1, 1.0)
    assert len(corners(planner, "G2 I10 F6000")) == math.ceil(20 * math.pi / 0.1) + 1
    planner.set_arc_precision(100.0, 0.2)
    assert len(corners(planner, "G2 I10 F6000")) == math.ceil(2 * math.pi / (2 * math.acos(1 - 0.02))) + 1
    planner.set_arc_precision(100.0, 10.0)
    assert len(corners(planner, "G2 I1 F6000")) == 9  # however coarse, a circle has eight corners


def test_a_long_arc_waits_for_room_and_goes_on_where_it_was() -> None:
    planner = at_start()
    planner.set_arc_precision(0.01, 1.0)
    found = corners(planner, "G2 I50 E10 F6000")
    assert len(found) == math.ceil(100 * math.pi / 0.01) + 1
    assert planner.lines == 1
    assert found[:, 3] == pytest.approx(np.linspace(0, 10, len(found)), abs=1e-6)


def test_an_arc_can_be_put_aside() -> None:
    planner = at_start()
    planner.set_arc_precision(0.01, 1.0)
    text = b"G2 I50 E10 F6000\n"
    assert planner.feed(text, 0, len(text), final=True).status is FeedStatus.FULL
    assert planner.arc_open
    stood = planner.toolhead_position
    aside = planner.suspend_program()
    assert not planner.arc_open
    drain(planner)
    other = b"G1 X100\nG1 X110\n"
    assert planner.feed(other, 0, len(other), final=True).status is FeedStatus.NEED_DATA
    flushed(planner)
    planner.set_position(stood)
    planner.resume_program(aside)
    while planner.feed(text, 0, len(text), final=True).status is FeedStatus.FULL:
        drain(planner)
    flushed(planner)
    assert planner.toolhead_position == (*START, 10.0)
    assert planner.lines == 1


@pytest.mark.parametrize(
    ("words", "fault"),
    [
        ({"X": 110.0}, ArcFault.NO_CENTER),
        ({"X": 110.0, "K": 5.0}, ArcFault.NO_CENTER),
        ({"X": 110.0, "I": 5.0, "R": 5.0}, ArcFault.NO_CENTER),
        ({"X": 110.0, "R": 4.9}, ArcFault.RADIUS),
        ({"R": 4.0}, ArcFault.RADIUS),
        ({"X": 110.0, "R": 0.0}, ArcFault.RADIUS),
        ({"X": 110.0, "I": 4.9}, ArcFault.UNEQUAL),
        ({"X": 110.0, "I": 0.0}, ArcFault.UNEQUAL),
        ({"X": 110.0, "I": 1e300}, ArcFault.HUGE),
        ({"X": 1e300, "I": 1.0}, ArcFault.HUGE),
        ({"X": 110.0, "R": 1e200}, ArcFault.HUGE),
    ],
)
def test_what_is_no_arc_changes_nothing(words: dict[str, float], fault: ArcFault) -> None:
    planner = at_start()
    assert planner.begin_arc(words, clockwise=True) is fault
    assert not planner.arc_open
    assert planner.toolhead_position == (*START, 0.0)
    assert str(fault)


def test_an_arc_that_is_left_out_goes_to_its_end_at_once() -> None:
    """Failed before: it was followed in up to 2^20 pieces, 20 ms for a line of 11 bytes."""
    planner = at_start()
    planner.excluded = True
    for text, end, retracted_mm in (
        (b"G2 I166000 E3\n", (*START, 3.0), 0.0),
        (b"G3 X110 Y120 Z121 I10 E1 F3000\n", (110.0, 120.0, 121.0, 1.0), 2.0),
    ):
        assert planner.feed(text, 0, len(text), final=True).status is FeedStatus.NEED_DATA
        assert (planner._state.arc.pieces, planner.arc_open) == (1, False)
        assert (planner.gcode_position, planner.retracted_mm) == (end, retracted_mm)
    assert (planner.toolhead_position, planner.speed_mm_s) == ((*START, 0.0), 50.0)


def test_limits_hold_on_the_way() -> None:
    planner = at_start()
    text = b"G2 X102 I1 J160\n"  # both ends are inside, the way is not
    feed = planner.feed(text, 0, len(text), final=True)
    while feed.status is FeedStatus.FULL:
        drain(planner)
        feed = planner.feed(text, 0, len(text), final=True)
    assert feed.status is FeedStatus.LIMIT
    assert not planner.arc_open
    assert "outside" in str(planner.fault)
    unhomed = Planner(planner.limits)
    assert unhomed.feed(b"G3 I1 J1\n", 0, 9, final=True).status is FeedStatus.LIMIT


def test_a_rounded_center_is_good_enough_and_the_end_is_exact() -> None:
    planner = at_start()
    found = corners(planner, "G2 X107.071 Y107.071 I0 J-10.005 F6000")
    assert len(found) > 3
    assert planner.toolhead_position[:2] == (107.071, 107.071)
