"""Where a delta's rods lie flat the head is slower, by exactly as much as the carriages are too fast."""

import math
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from coordinator.kinematics.delta import Delta, Tower
from coordinator.motion.planner.planner import Planner
from tests.coordinator.motion.planner_helpers import LIMITS, flushed, joined

USUAL_TOWER_SPEED = 3.0
"""How much faster than the head a carriage may be (planner_move.c)."""
ROD, RADIUS = 207.0, 100.0
DELTA = Delta(
    (
        Tower(math.radians(210), ROD, 300),
        Tower(math.radians(330), ROD, 300),
        Tower(math.radians(90), ROD, 300),
    ),
    RADIUS,
    print_radius=105,
)
SPACE = DELTA.work_space
MACHINE = replace(
    LIMITS,
    position_min=SPACE.low,
    position_max=SPACE.high,
    max_radius=SPACE.max_radius,
    max_velocity=200,
    max_accel=3000,
    tower_radius=SPACE.tower_radius,
    tower_rod=SPACE.tower_rod,
)


def fastest(*places: tuple[float, float]) -> float:
    """Return the highest speed of moves from the first of PLACES (X Y) to the last, asked for at 200 mm/s."""
    planner = Planner(MACHINE)
    planner.homed = "XYZ"
    planner.flush()
    planner.set_position((*places[0], 1.0, 0.0))
    for x, y in places[1:]:
        planner.move({"X": x, "Y": y, "F": 12000.0})
    return float(max(joined(flushed(planner))["cruise_v"]))


def carriage_share(radius: float) -> float:
    level = RADIUS + radius
    return level / math.sqrt(ROD**2 - level**2)


def test_within_the_usual_speed_nothing_is_slower() -> None:
    assert carriage_share(96) < USUAL_TOWER_SPEED
    assert fastest((-90.0, 0.0), (90.0, 0.0)) == pytest.approx(200)


@given(st.floats(97.0, 105.0))
def test_further_out_no_carriage_is_faster_than_that(radius: float) -> None:
    speed = fastest((-60.0, 0.0), (radius, 0.0))
    assert speed * carriage_share(radius) <= 200 * USUAL_TOWER_SPEED * (1 + 1e-9)
    assert speed * carriage_share(radius) >= 199 * USUAL_TOWER_SPEED


def test_a_move_from_the_rim_is_as_slow_as_one_to_it() -> None:
    assert fastest((105.0, 0.0), (-60.0, 0.0)) == pytest.approx(fastest((-60.0, 0.0), (105.0, 0.0)))
