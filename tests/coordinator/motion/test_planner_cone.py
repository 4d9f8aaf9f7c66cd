"""Above the box, a machine that homes there stays within its cone."""

import math
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from coordinator.motion.planner.planner import FaultKind, FeedStatus, Planner
from tests.coordinator.motion.planner_helpers import LIMITS

TOP = 300.0
DELTA = replace(
    LIMITS,
    position_min=(-100, -100, 0),
    position_max=(100, 100, 250),
    cone_slope=(0.5, 0.25),
    cone_top=TOP,
)


def homed(z: float = TOP) -> Planner:
    planner = Planner(DELTA)
    planner.homed = "XYZ"
    planner.flush()
    planner.set_position((0, 0, z, 0))
    return planner


def go(planner: Planner, **words: float) -> FeedStatus:
    return planner.move(words)


def test_down_within_the_cone_and_around_in_the_box() -> None:
    planner = homed()
    assert go(planner, X=100, Y=0, Z=250) is FeedStatus.NEED_DATA
    assert go(planner, X=-100, Y=100, Z=250) is FeedStatus.NEED_DATA


@pytest.mark.parametrize(
    "words", [{"X": 1.0}, {"Y": 1.0}, {"X": 100.0, "Z": 250.01}, {"X": 90.0, "Z": 256.0}]
)
def test_too_flat_a_way_down_is_refused(words: dict[str, float]) -> None:
    planner = homed()
    assert go(planner, **words) is FeedStatus.LIMIT
    fault = planner.fault
    assert (fault.kind, fault.axis) == (FaultKind.OUTSIDE, "Z")
    assert fault.high == pytest.approx(TOP - 0.5 * words.get("X", 0) - 0.25 * words.get("Y", 0))


def test_up_again_only_from_within_the_cone() -> None:
    planner = homed(100)
    assert go(planner, Z=TOP) is FeedStatus.NEED_DATA
    assert go(planner, X=60, Z=250) is FeedStatus.NEED_DATA
    assert go(planner, X=0, Z=290) is FeedStatus.NEED_DATA
    assert go(planner, X=0, Z=TOP + 0.001) is FeedStatus.LIMIT
    assert go(planner, X=100, Y=100, Z=250) is FeedStatus.LIMIT  # outside of the cone, though in the box
    assert go(planner, X=100, Y=100, Z=100) is FeedStatus.NEED_DATA
    assert go(planner, Z=250) is FeedStatus.NEED_DATA
    assert go(planner, X=0, Y=0, Z=260) is FeedStatus.LIMIT  # from a place that is not below the cone
    assert planner.fault.high == 250


def test_a_head_homed_a_little_above_the_tip_can_leave() -> None:
    """Endstops of unequal height leave it there."""
    assert go(homed(TOP + 0.8), X=5, Z=200) is FeedStatus.NEED_DATA


def in_cone(x: float, y: float, z: float) -> bool:
    return z + math.hypot(0.5 * x, 0.25 * y) <= TOP + 1e-6


@given(st.lists(st.tuples(*(st.floats(-100, 100),) * 2, st.floats(0, 305)), max_size=20))
def test_every_place_on_the_way_is_in_the_box_or_in_the_cone(
    points: list[tuple[float, float, float]],
) -> None:
    planner = homed()
    at = (0.0, 0.0, TOP)
    for point in points:
        x, y, z = point
        if go(planner, X=x, Y=y, Z=z) is not FeedStatus.NEED_DATA:
            continue
        for i in range(11):
            x, y, z = (a + (b - a) * i / 10 for a, b in zip(at, point, strict=True))
            assert z <= 250 + 1e-6 or in_cone(x, y, z)
        at = point
