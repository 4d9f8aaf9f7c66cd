"""What moves are going to push is known by print time, in the thread of the heaters."""

from typing import Any

import numpy as np
import pytest

from coordinator.motion.planner._planner import ffi
from coordinator.motion.trapezoid_array import TRAPEZOID
from coordinator.runtime.filament_forecast import KEPT_S, FilamentForecast

DRIVEN = (0.0, 0.0, 0.0, 1.0)
AT_REST = (0.0, 0.0, 0.0, 0.0)


def see(forecast: FilamentForecast, *moves: tuple[float, float, float, float]) -> None:
    """Plan moves: begin, seconds, mm/s of the head, mm of filament per mm."""
    array = np.zeros(len(moves), TRAPEZOID)
    for row, (begin_s, seconds, speed, ratio) in zip(array, moves, strict=True):
        row["print_time"], row["cruise_s"], row["cruise_v"], row["start_v"] = begin_s, seconds, speed, speed
        row["ratio"][3] = ratio
    plan(forecast, array)


def plan(forecast: FilamentForecast, array: Any) -> None:
    forecast.see_moves(ffi.cast("struct trapezoid *", ffi.from_buffer(array)), len(array))


def wanted(*extruders: str) -> FilamentForecast:
    forecast = FilamentForecast()
    for extruder in extruders or ("extruder",):
        forecast.want(extruder)
    return forecast


def test_speeds_are_those_of_the_time_that_is_asked_for() -> None:
    forecast = wanted()
    see(forecast, (10.0, 2.0, 100.0, 0.05), (12.0, 1.0, 200.0, 0.0), (13.0, 2.0, 60.0, 0.05))
    assert forecast.mm_per_s("extruder", 10.0, 12.0) == pytest.approx(5)
    assert forecast.mm_per_s("extruder", 11.0, 13.0) == pytest.approx(2.5)
    assert forecast.mm_per_s("extruder", 12.2, 12.8) == 0
    assert forecast.mm_per_s("extruder", 14.0, 15.0) == pytest.approx(3)
    assert forecast.mm_per_s("extruder", 5.0, 9.0) == 0
    assert forecast.mm_per_s("extruder", 14.5, 16.0) == pytest.approx(3), "nothing else is known yet"
    assert forecast.mm_per_s("extruder", 15.0, 16.0) == 0
    see(forecast, (20.0, 1.0, 100.0, 0.05))
    assert forecast.mm_per_s("extruder", 15.0, 19.0) == 0
    assert forecast.mm_per_s("extruder", 14.0, 20.5) == pytest.approx((3 + 2.5) / 6.5)


def test_acceleration_is_reckoned_with() -> None:
    forecast, array = wanted(), np.zeros(1, TRAPEZOID)
    move = array[0]
    move["accel_s"] = move["decel_s"] = move["cruise_s"] = 1.0
    move["accel"], move["cruise_v"], move["ratio"][3] = 50.0, 50.0, 0.1
    plan(forecast, array)
    assert forecast.mm_per_s("extruder", 0.0, 3.0) * 3 == pytest.approx(10)


def test_what_was_pulled_back_is_hot_already() -> None:
    forecast = wanted()
    see(forecast, (0.0, 1.0, 10.0, 1.0), (1.0, 1.0, 5.0, -1.0), (2.0, 1.0, 5.0, 1.0), (3.0, 1.0, 2.0, 1.0))
    assert [forecast.mm_per_s("extruder", n, n + 1) for n in range(4)] == pytest.approx([10, 0, 0, 2])
    see(forecast, (4.0, 1.0, 3.0, -1.0))
    see(forecast, (5.0, 1.0, 4.0, 1.0))
    assert forecast.mm_per_s("extruder", 5.0, 6.0) == pytest.approx(1)


def test_each_extruder_has_its_own() -> None:
    forecast = wanted("extruder", "extruder1")
    see(forecast, (0.0, 1.0, 10.0, 1.0))
    forecast.follow({"extruder": AT_REST, "extruder1": DRIVEN})
    see(forecast, (1.0, 1.0, 7.0, 1.0))
    assert [forecast.mm_per_s("extruder", n, n + 1) for n in range(2)] == pytest.approx([10, 0])
    assert [forecast.mm_per_s("extruder1", n, n + 1) for n in range(2)] == pytest.approx([0, 7])


def test_nobody_asks_nothing_is_kept() -> None:
    forecast = FilamentForecast()
    see(forecast, (0.0, 1.0, 10.0, 1.0))
    assert not forecast.is_wanted
    assert forecast.mm_per_s("extruder", 0.0, 1.0) == 0


def test_the_past_is_forgotten() -> None:
    forecast = wanted()
    for n in range(1000):
        see(forecast, (n * 1.0, 1.0, 10.0, 1.0))
    assert len(forecast._tracks["extruder"].chunks) <= KEPT_S + 2
    assert forecast.mm_per_s("extruder", 990.0, 999.0) == pytest.approx(10)
