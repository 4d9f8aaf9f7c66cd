"""The watch over heaters: finds what is broken, and leaves in peace what is in order."""

from typing import TYPE_CHECKING

import pytest

from coordinator.heat.controller import Controller
from coordinator.heat.pid import Pid, PidGains
from coordinator.heat.verify import HeaterCheck, VerifyOptions
from coordinator.heat.watermark import Watermark
from tests.coordinator.heat.plant import INTERVAL_S, Plant, bed

if TYPE_CHECKING:
    from collections.abc import Callable

BED = VerifyOptions(check_gain_s=60)


class Watched:
    """A plant under a controller and a check; what the sensor says may be replaced."""

    def __init__(self, plant: Plant, controller: Controller, options: VerifyOptions) -> None:
        self.plant, self.controller, self.check = plant, controller, HeaterCheck(options)
        self.power = 0.0
        self.sees: Callable[[float], float] = lambda celsius: celsius
        self.heats: Callable[[float], float] = lambda power: power

    def run(self, target_c: float, seconds: float) -> str | None:
        for _ in range(round(seconds / INTERVAL_S)):
            now_s, measured_c = self.plant.now_s, self.sees(self.plant.measure())
            fault = self.check.check(now_s, measured_c, target_c, self.power)
            if fault is not None:
                return fault
            self.power = self.controller.power(now_s, measured_c, target_c)
            self.plant.run(self.heats(self.power), INTERVAL_S)
        return None


def hot_end(**options: float) -> Watched:
    return Watched(Plant(fan_loss=0.05, **options), Pid(PidGains(22.2, 1.08, 114)), VerifyOptions())  # type: ignore[arg-type]


def test_a_day_of_a_healthy_hot_end() -> None:
    watched = hot_end()
    for target in (200, 0, 240, 180, 0, 250, 215, 220, 5, 200, 0):
        assert watched.run(target, 240) is None
        watched.plant.fan = 1.0 - watched.plant.fan


def test_a_healthy_bed_with_a_watermark() -> None:
    watched = Watched(bed(), Watermark(), BED)
    for target, seconds in ((60, 900), (0, 600), (90, 1200), (40, 900)):
        assert watched.run(target, seconds) is None


def test_a_heater_that_does_not_heat() -> None:
    watched = hot_end()
    watched.heats = lambda power: 0.0
    fault = watched.run(200, 22)
    assert fault is not None
    assert "did not get 2 K nearer to 200 °C in 20 s" in fault


def test_a_heater_that_stops_heating_on_its_way() -> None:
    watched = hot_end()
    assert watched.run(200, 30) is None
    watched.heats = lambda power: 0.0
    assert watched.run(200, 50) is not None


def test_a_heater_that_stops_heating_at_its_target() -> None:
    watched = hot_end()
    assert watched.run(200, 200) is None
    watched.heats = lambda power: 0.0
    before_s = watched.plant.now_s
    fault = watched.run(200, 120)
    assert fault is not None
    assert "does not hold 200 °C" in fault
    assert watched.plant.now_s - before_s < 40


def test_a_sensor_that_fell_out_is_found_before_the_block_burns() -> None:
    watched = hot_end()
    assert watched.run(200, 200) is None
    fell_s = watched.plant.now_s
    watched.sees = lambda celsius: 22 + (celsius - 22) * 0.5 ** ((watched.plant.now_s - fell_s) / 5)
    fault = watched.run(200, 120)
    assert fault is not None
    assert watched.plant.block_c < 260


def test_a_sensor_that_fell_out_cold_is_found() -> None:
    watched = hot_end()
    watched.sees = lambda celsius: 22 + (celsius - 22) * 0.02
    fault = watched.run(200, 60)
    assert fault is not None
    assert watched.plant.block_c < 100


def test_a_switch_that_is_stuck_is_told() -> None:
    watched = hot_end()
    assert watched.run(0, 60) is None
    watched.heats = lambda power: 1.0
    fault = watched.run(0, 30)
    assert fault is not None
    assert "heats though it is off" in fault


def test_the_heat_left_in_a_block_is_no_stuck_switch() -> None:
    watched = Watched(bed(), Watermark(), BED)
    watched.plant.sensor_tau_s = 25
    assert watched.run(100, 60) is None
    assert watched.run(0, 300) is None


def test_a_bed_below_does_not_look_like_a_stuck_switch() -> None:
    watched = hot_end()
    assert watched.run(0, 60) is None
    watched.plant.other_w = 3.0
    assert watched.run(0, 600) is None


@pytest.mark.parametrize(("below", "seconds"), [(1.0, 120.0), (4.0, 30.0), (24.0, 5.0)])
def test_the_error_gathers_below_the_range(below: float, seconds: float) -> None:
    check = HeaterCheck(VerifyOptions(max_error_ks=120, hysteresis_k=5))
    now_s = 10.0
    assert check.check(now_s, 200, 200, 0.3) is None
    while check.check(now_s, 195 - below, 200, 0.3) is None:
        now_s += 0.5
    assert now_s - 10 == pytest.approx(seconds, abs=0.6)


def test_in_range_again_the_error_is_forgotten_and_a_gap_counts_little() -> None:
    check = HeaterCheck(VerifyOptions())
    for now_s, celsius in ((0, 200), (1, 190), (2, 190), (3, 196), (4, 185)):
        assert check.check(now_s, celsius, 200, 0.5) is None
    assert check.error_ks == pytest.approx(10)
    assert check.check(10_000, 185, 200, 0.5) is None, "the host slept: nobody measured meanwhile"
    assert check.error_ks == pytest.approx(60)
