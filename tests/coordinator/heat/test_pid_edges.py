"""PID at its limits, in numbers that are exact in binary: a gain of 255 is full power for a kelvin."""

import pytest

from coordinator.heat.pid import Pid, PidGains


def pid(kp: float, ki: float = 0.0, kd: float = 0.0, **options: float) -> Pid:
    """Return a controller whose gains are in full powers."""
    return Pid(PidGains(kp * 255, ki * 255, kd * 255), **options)


def with_integral(kp: float = 1.0, kd: float = 0.0) -> Pid:
    """Return one at time 1 s and 100 °C, which has half of full power in its integral."""
    controller = pid(kp, 1.0, kd)
    controller.power(0.0, 100.0, 100.0)
    controller._integral_power = 0.5
    assert controller.power(1.0, 100.0, 100.0) == 0.5
    return controller


def integral(controller: Pid) -> float:
    return controller.held[1]


def test_it_begins_with_nothing_gathered_and_full_power_allowed() -> None:
    controller = pid(0.125)
    assert controller.gains == PidGains(31.875, 0.0, 0.0)
    assert controller.power(0.0, 100.0, 102.0) == 0.25
    assert controller.power(1.0, 100.0, 150.0) == 1.0


def test_the_slope_is_smoothed_over_a_second_unless_it_is_told() -> None:
    for options, k_per_s in (({}, 1.0), ({"smooth_s": 2.0}, 0.5)):
        controller = pid(0.0, 0.0, 0.25, **options)
        controller.power(0.0, 100.0, 100.0)
        controller.power(1.0, 99.0, 100.0)
        slope, _ = controller.held
        assert slope.k_per_s == -k_per_s
        assert controller.power(1.0, 99.0, 100.0) == 0.25 * k_per_s


def test_of_a_long_gap_two_seconds_count() -> None:
    controller = pid(0.0, 0.125)
    controller.power(0.0, 100.0, 101.0)
    assert controller.power(2.0, 100.0, 101.0) == 0.25
    assert controller.power(60.0, 100.0, 101.0) == 0.5


def test_the_integral_is_full_power_at_most() -> None:
    controller = pid(0.0, 1.0, max_power=0.75)
    controller.power(0.0, 100.0, 101.0)
    for now_s in (0.5, 1.0):
        controller.power(now_s, 100.0, 101.0)
    assert integral(controller) == 0.75
    assert controller.power(2.0, 100.0, 99.75) == 0.5


def test_it_gathers_nothing_once_power_is_at_its_limit() -> None:
    controller = pid(1.0, 1.0)
    controller.power(0.0, 100.0, 101.0)
    assert controller.power(1.0, 100.0, 101.0) == 1.0, "the error alone is exactly full power"
    assert integral(controller) == 0.0
    controller.power(2.0, 100.0, 100.75)
    assert integral(controller) == 0.75, "just below it does"
    controller.power(3.0, 100.0, 100.5)
    assert integral(controller) == 0.75, "more than a power of 1, less than a kelvin"


def test_it_loses_nothing_once_power_is_none() -> None:
    controller = with_integral()
    assert controller.power(2.0, 100.0, 99.5) == 0.0, "the error takes exactly what was gathered"
    assert integral(controller) == 0.5
    controller.power(3.0, 100.0, 99.75)
    assert integral(controller) == 0.25, "a little more power, and it does"


def test_it_goes_on_gathering_where_that_leads_away_from_the_limit() -> None:
    controller = with_integral(kp=0.0, kd=1.0)
    assert controller.power(2.0, 102.0, 102.25) == 0.0, "below its target, and it rises fast"
    assert integral(controller) == 0.75
    controller = with_integral(kp=0.0, kd=1.0)
    assert controller.power(2.0, 98.0, 97.75) == 1.0, "above its target, and it falls fast"
    assert integral(controller) == 0.25


@pytest.mark.parametrize(("target_c", "power"), [(0.0, 0.0), (-1.0, 0.0), (1.0, 1.0)])
def test_off_is_a_target_of_nothing_however_cold_it_is(target_c: float, power: float) -> None:
    controller = with_integral()
    assert controller.power(2.0, -40.0, target_c) == power
    assert integral(controller) == (0.5 if power else 0.0)


@pytest.mark.parametrize(
    ("celsius", "k_per_s", "settled"),
    [
        (99.0, 0.0, True),
        (101.0, 0.0, True),
        (98.99, 0.0, False),
        (101.01, 0.0, False),
        (100.0, 0.1, True),
        (100.0, -0.1, True),
        (100.0, 0.11, False),
        (100.0, -0.11, False),
    ],
)
def test_it_is_settled_within_a_kelvin_and_a_tenth_per_second(
    celsius: float, k_per_s: float, settled: bool
) -> None:
    controller = pid(1.0)
    slope, _ = controller.held
    slope.k_per_s = k_per_s
    assert controller.settled(celsius, 100.0) is settled


def test_another_one_goes_on_with_what_was_gathered() -> None:
    before, after = with_integral(), pid(1.0)
    after.go_on_from(before)
    assert after.held == before.held
