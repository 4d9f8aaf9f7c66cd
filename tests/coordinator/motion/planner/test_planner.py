"""The planner through its Python skin: order, bounds, refusals, standstill."""

import dataclasses
import math
import random
from functools import reduce
from operator import xor

import numpy as np
import pytest

from coordinator.motion.planner.language import ArcFault
from coordinator.motion.planner.planner import RING_TRAPEZOIDS, FaultKind, FeedStatus, Planner
from coordinator.motion.trapezoid_array import array_of
from tests.coordinator.motion.planner_helpers import (
    LIMITS,
    check_invariants,
    drain,
    end_speeds,
    flushed,
    homed_planner,
    joined,
    planned,
)


def wiggle(count: int, step_mm: float, seed: int = 1) -> bytes:
    """Random walk of COUNT moves with turns of every size."""
    rng = random.Random(seed)
    x = y = 125.0
    angle = 0.0
    lines = ["G1 X125 Y125 F12000"]
    for _ in range(count):
        angle += rng.gauss(0, rng.choice([0.01, 0.1, 1]))
        x = min(max(x + step_mm * math.cos(angle), 0), 250)
        y = min(max(y + step_mm * math.sin(angle), 0), 250)
        lines.append(f"G1 X{x:.4f} Y{y:.4f}")
    return "\n".join(lines).encode() + b"\n"


# ---- Order, bounds ----


@pytest.mark.parametrize("step_mm", [0.02, 0.3, 5])
def test_the_result_does_not_depend_on_how_the_text_is_cut(step_mm: float) -> None:
    text = wiggle(3000, step_mm)
    whole = planned(homed_planner(), text)
    check_invariants(whole)
    for chunk in (17, 100, 5000):
        assert planned(homed_planner(), text, chunk).tobytes() == whole.tobytes()


def test_the_result_does_not_depend_on_when_trapezoids_are_taken() -> None:
    text = wiggle(6000, 0.3)
    whole = planned(homed_planner(), text)
    planner = homed_planner()
    rng = random.Random(2)
    pieces = []
    start = 0

    def take_some() -> None:
        batch = planner.take()
        count = rng.randint(0, min(batch.count, 700))
        pieces.append(array_of(batch)[:count].copy())
        planner.release(count)

    while (feed := planner.feed(text, start, len(text), final=True)).status is FeedStatus.FULL:
        start = feed.offset
        take_some()
    while not planner.flush():
        take_some()
    assert joined(pieces + drain(planner)).tobytes() == whole.tobytes()


def test_a_full_ring_stops_the_feed_and_loses_nothing() -> None:
    planner = homed_planner()
    text = wiggle(3 * RING_TRAPEZOIDS, 1)
    feed = planner.feed(text, 0, len(text), final=True)
    assert feed.status is FeedStatus.FULL
    assert planner.feed(text, feed.offset, len(text), final=True) == feed
    assert planner.take().count == RING_TRAPEZOIDS
    assert not planner.flush()
    with pytest.raises(ValueError, match="fewer were waiting"):
        planner.release(RING_TRAPEZOIDS + 1)


def test_an_overflowing_queue_stays_within_all_limits() -> None:
    # A long straight run of tiny moves: nothing settles before the machine could stop again.
    lines = b"".join(b"G1 X%.4f\n" % (i / 2000) for i in range(1, 60_000))
    limits = dataclasses.replace(LIMITS, max_accel=100)
    planner = homed_planner(limits)
    t = planned(planner, b"G1 F24000\n" + lines)
    assert planner.moves_overflowed > 0
    assert planner.at_standstill
    assert len(t) == 59_999
    check_invariants(t, limits, end=planner.toolhead_position)
    # Half a queue (1 mm) is always there to accelerate in: the run must not crawl.
    assert t["cruise_v"].max() > 10


def test_pacing_by_print_time() -> None:
    planner = homed_planner()
    text = wiggle(2000, 1)
    planner.plan_until_s = 1.0
    feed = planner.feed(text, 0, len(text), final=True)
    assert feed.status is FeedStatus.FULL
    assert 1.0 <= planner.print_time_end_s < 2.0
    planner.plan_until_s = math.inf
    assert planner.feed(text, feed.offset, len(text), final=True).status is FeedStatus.NEED_DATA


# ---- What moves look like ----


def test_one_move_by_hand() -> None:
    limits = dataclasses.replace(LIMITS, max_accel=1000, minimum_cruise_ratio=0)
    t = planned(homed_planner(limits), b"G1 X100 F6000")
    assert len(t) == 1
    assert (t["accel_s"][0], t["decel_s"][0]) == pytest.approx((0.1, 0.1))
    assert t["cruise_s"][0] == pytest.approx(0.9)
    assert t["cruise_v"][0] == 100


def test_a_right_angle_is_taken_at_the_square_corner_velocity() -> None:
    t = planned(homed_planner(), b"G1 X50 F12000\nG1 Y50\n")
    assert t["start_v"][1] == pytest.approx(LIMITS.square_corner_velocity)


@pytest.mark.parametrize("ratio", [0.0, 0.5, 0.8])
def test_minimum_cruise_of_a_lone_short_move(ratio: float) -> None:
    limits = dataclasses.replace(LIMITS, minimum_cruise_ratio=ratio)
    t = planned(homed_planner(limits), b"G1 X1 F24000\n")
    assert t["cruise_v"][0] * t["cruise_s"][0] == pytest.approx(ratio * 1, abs=1e-9)


def test_two_hills_with_a_plateau_between_have_their_own_tops() -> None:
    # Fast and long, slow, fast and long: the slow middle must not hold the second hill down.
    t = planned(homed_planner(), b"G1 X5 F24000\nG1 X10 F1800\nG1 X12 F1800\nG1 X240 F24000\n")
    assert t["cruise_v"][0] < 400
    assert t["cruise_v"][1] == t["cruise_v"][2] == 30
    assert t["cruise_v"][3] == 400


def test_filament_alone_stands_the_machine_still() -> None:
    t = planned(homed_planner(), b"G1 X50 F12000\nG1 E-2\nG1 X100\n")
    assert (t["start_v"] == 0).all()
    assert t["ratio"][1].tolist() == [0, 0, 0, -1]
    assert t["cruise_v"][1] <= LIMITS.max_extrude_only_velocity


def test_the_filament_may_jump_by_its_corner_velocity() -> None:
    t = planned(homed_planner(), b"G1 X50 F12000\nG1 X100 E1\n")
    assert t["start_v"][1] * 0.02 == pytest.approx(LIMITS.instantaneous_corner_velocity)


def test_moves_without_length_are_dropped_and_nothing_is_lost() -> None:
    planner = homed_planner()
    planner.relative = True
    t = planned(planner, b"G1 X10\nG1\nG1 X0\n" + b"G1 X0.0000000001\n" * 10_000 + b"G1 X10\n")
    assert planner.moves_dropped > 9000
    assert t["start"][-1][0] + 10 == pytest.approx(20.000001, abs=2e-9)
    check_invariants(t, end=planner.toolhead_position)
    assert planner.toolhead_position[0] == pytest.approx(20.000001, abs=1e-12)


def test_the_commands_between_moves_that_are_read_with_them() -> None:
    planner = homed_planner()
    text = b"""M204 P3000 T2000
G92 X5 E-1.5 ; X 0 reads as 5
G1 X15 F12000
m204 T1000 (travel)
G1 X25
N7 M204 S5000 P1*27
G92
G1 X10
"""
    feed = planner.feed(text, 0, len(text), final=True)
    assert feed == (FeedStatus.OTHER_LINE, text.index(b"N7"), 6), "a wrong checksum is for Python"
    text = text.replace(b"*27", b"*%d" % reduce(xor, b"N7 M204 S5000 P1"))
    feed = planner.feed(text, feed.offset, len(text), final=True)
    assert feed == (FeedStatus.NEED_DATA, len(text), 9)
    t = joined(flushed(planner))
    assert t["accel"].tolist() == [2000, 1000, 5000], "T alone is for travel, as are these moves"
    assert t["start"][:, 0].tolist() == [0, 10, 20]
    assert planner.gcode_base == (20, 0, 0, 0)
    planner.set_accel_words({"P": 3000})
    assert (planner.accel, planner.travel_accel) == (3000, 5000)
    planner.set_accel_words({"P": 3000, "T": 4000})
    assert (planner.accel, planner.travel_accel) == (3000, 3000)


@pytest.mark.parametrize(
    "line", [b"M204 S10001", b"M204 S0", b"M204", b"M204 P-1", b"M204 X1", b"G92 F1", b"G92.1"]
)
def test_commands_that_python_has_to_judge(line: bytes) -> None:
    planner = homed_planner()
    assert planner.feed(line, 0, len(line), final=True) == (FeedStatus.OTHER_LINE, 0, 1)
    assert planner.accel == LIMITS.max_accel


def test_a_change_of_acceleration_holds_from_its_place_on() -> None:
    planner = homed_planner()
    text = b"G1 X50 F12000\nG1 X100\n"
    planner.feed(text, 0, 14, final=False)
    planner.accel = 1000
    planner.feed(text, 14, len(text), final=True)
    assert joined(flushed(planner))["accel"].tolist() == [10000, 1000]
    planner.accel = 1e6
    assert planner.accel == LIMITS.max_accel


# ---- Standstill ----


def test_dwell_and_restart() -> None:
    planner = homed_planner()
    planner.feed(b"G1 X10\n", 0, 7, final=True)
    with pytest.raises(RuntimeError, match="flush"):
        planner.dwell(1)
    assert planner.flush()
    end = planner.print_time_end_s
    planner.dwell(1.5)
    planner.begin_at(0.1)
    assert planner.print_time_end_s == end + 1.5
    planner.begin_at(100)
    planner.feed(b"G1 X20\n", 0, 7, final=True)
    t = joined(flushed(planner))
    assert t["print_time"].tolist() == [0, 100]
    assert t["start_v"].tolist() == [0, 0]
    assert abs(end_speeds(t)).max() < 1e-9
    planner.set_position((1, 2, 3, 4))
    assert planner.toolhead_position == planner.gcode_position == (1, 2, 3, 4)
    for bad in (-1.0, math.nan, math.inf):
        with pytest.raises(ValueError, match="dwell"):
            planner.dwell(bad)


# ---- Refusals ----


@pytest.mark.parametrize(
    ("text", "kind", "sentence"),
    [
        (b"G1 X250.1", FaultKind.OUTSIDE, "X 250.1 mm, outside 0 to 250 mm"),
        (b"G1 Z-0.01", FaultKind.OUTSIDE, "Z -0.01 mm, outside 0 to 250 mm"),
        (b"G1 Y999999999999999999", FaultKind.OUTSIDE, "outside 0 to 250 mm"),
        (b"G1 E51", FaultKind.EXTRUDE_LONG, "51 mm of filament at once, more than 50 mm"),
        (b"G1 X6 E-51", FaultKind.EXTRUDE_LONG, "51 mm of filament at once, more than 50 mm"),
        (b"G1 X5.001 E-99999999", FaultKind.EXTRUDE_LONG, "filament at once, more than 50 mm"),
        (b"G1 X6 E3", FaultKind.EXTRUDE_RATIO, "3 mm of filament per mm of path, more than 2.08"),
        (b"G1 F0 X1", FaultKind.SPEED, "0 mm/s"),
        (b"G1 F-100 X1", FaultKind.SPEED, "not above 0"),
        (b"G1 F-100", FaultKind.SPEED, "not above 0"),
    ],
)
def test_refused_moves_change_nothing(text: bytes, kind: FaultKind, sentence: str) -> None:
    planner = homed_planner()
    feed = planner.feed(b"G1 X5\n" + text, 0, 6 + len(text), final=True)
    assert feed == (FeedStatus.LIMIT, 6, 2)
    assert planner.fault.kind is kind
    assert sentence in str(planner.fault)
    assert planner.toolhead_position == planner.gcode_position == (5, 0, 0, 0)
    assert planner.speed_mm_s == 25


def test_a_speed_below_0_is_refused_also_where_nothing_moves() -> None:
    planner = homed_planner()
    planner.excluded = True
    for text in (b"G1 X9 F-1", b"G2 I5 F-1", b"G1 F-.0000001"):
        feed = planner.feed(text, 0, len(text), final=True)
        assert feed.status is not FeedStatus.NEED_DATA, text
    assert planner.begin_arc({"I": 5.0, "F": -1.0}, clockwise=True) is ArcFault.SPEED
    assert (planner.speed_mm_s, planner.gcode_position) == (25, (0, 0, 0, 0))
    assert planner.feed(b"G1 F0", 0, 5, final=True).status is FeedStatus.NEED_DATA
    assert planner.speed_mm_s == 0, "which no move takes, but a program may say it"


def test_an_axis_moves_only_when_it_is_homed() -> None:
    planner = Planner(LIMITS)
    planner.homed = "XY"
    assert planner.feed(b"G1 X5 Y5 E1\nG1 Z1\n", 0, 18, final=True) == (FeedStatus.LIMIT, 12, 2)
    assert planner.fault.kind is FaultKind.NOT_HOMED
    assert "Z is to move before it is homed" in str(planner.fault)


@pytest.mark.parametrize(
    "changes",
    [
        {"max_accel": 0},
        {"max_velocity": math.nan},
        {"max_z_accel": -1},
        {"minimum_cruise_ratio": 1},
        {"position_max": (math.inf, 0, 0)},
    ],
)
def test_limits_it_cannot_calculate_with_are_refused(changes: dict[str, object]) -> None:
    limits = dataclasses.replace(LIMITS, **changes)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match=next(iter(changes))):
        Planner(limits)


def test_a_view_outlives_the_planner() -> None:
    planner = homed_planner()
    planner.feed(b"G1 X10\n", 0, 7, final=True)
    assert planner.flush()
    view = array_of(planner.take())
    del planner
    assert np.isfinite(view["print_time"]).all()
