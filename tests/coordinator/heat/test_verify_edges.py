"""The watch over a heater to the tick: when exactly it finds a fault, and what it forgets when."""

import pytest

from coordinator.heat.verify import HeaterCheck, VerifyOptions

ON, OFF = 0.5, 0.0


def check() -> HeaterCheck:
    return HeaterCheck(VerifyOptions())


def approaching(begin_s: float = 100.0) -> HeaterCheck:
    """Return a check of a heater at 20 °C that has just been given 200 °C: 22 °C are due 20 s later."""
    found = check()
    assert found.check(begin_s, 20, 200, ON) is None
    return found


def holding(now_s: float = 100.0, target_c: float = 200) -> HeaterCheck:
    found = check()
    assert found.check(now_s, target_c, target_c, ON) is None
    return found


def test_the_defaults_are_those_of_a_hot_end() -> None:
    assert VerifyOptions() == VerifyOptions(
        max_error_ks=120.0, check_gain_s=20.0, hysteresis_k=5.0, heating_gain_k=2.0
    )


# ------------------------------------------------------------------------------------------------- heating up


def test_the_gain_is_due_at_the_end_of_its_time_and_not_before() -> None:
    found = approaching()
    assert found.check(119.99, 21.9, 200, ON) is None
    fault = found.check(120.0, 21.99, 200, ON)
    assert fault == (
        "is at 22.0 °C and did not get 2 K nearer to 200 °C in 20 s; check heater, sensor and their wires"
    )


def test_every_gain_begins_a_new_time_from_where_it_was_reached() -> None:
    found = approaching()
    assert found.check(119.0, 22.0, 200, ON) is None, "reached: 24 °C are due at 139"
    assert found.check(138.9, 23.9, 200, ON) is None
    assert found.check(139.0, 23.9, 200, ON) is not None
    found = approaching()
    assert found.check(101.0, 50.0, 200, ON) is None, "52 °C are due at 121"
    assert found.check(120.9, 51.9, 200, ON) is None
    assert found.check(121.0, 51.9, 200, ON) is not None


def test_while_it_falls_the_gain_counts_from_the_bottom() -> None:
    found = approaching()
    assert found.check(105.0, 15.0, 200, ON) is None, "17 °C do, and the time goes on"
    assert found.check(110.0, 16.0, 200, ON) is None, "a rise does not raise the goal"
    assert found.check(120.0, 17.0, 200, ON) is None
    assert found.check(139.9, 18.9, 200, ON) is None
    assert found.check(140.0, 18.9, 200, ON) is not None


def test_the_same_target_after_it_was_off_begins_a_new_time() -> None:
    found = approaching()
    assert found.check(110.0, 20.0, 0, ON) is None
    assert found.check(119.0, 20.0, 200, ON) is None
    assert found.check(138.9, 20.0, 200, ON) is None
    assert found.check(139.0, 20.0, 200, ON) is not None


# --------------------------------------------------------------------------------------------------- in range


def test_the_range_begins_five_kelvin_below_the_target() -> None:
    found = approaching()
    assert found.check(119.0, 195.0, 200, ON) is None, "in range: from now on it has to hold"
    assert found.check(120.0, 194.9, 200, ON) is None
    assert found.error_ks == pytest.approx(0.1)
    found = approaching()
    assert found.check(119.0, 194.9, 200, ON) is None, "not yet"
    assert found.check(120.0, 194.0, 200, ON) is None
    assert found.error_ks == 0.0


@pytest.mark.parametrize(("celsius", "holds"), [(195.0, True), (194.9, False)])
def test_a_target_that_is_in_range_at_once_has_to_be_held(celsius: float, holds: bool) -> None:
    found = check()
    assert found.check(0.0, celsius, 200, ON) is None
    assert found.check(1.0, 185.0, 200, ON) is None
    assert found.error_ks == (10.0 if holds else 0.0)


def test_the_error_is_a_fault_when_it_reaches_its_maximum() -> None:
    found = holding()
    for second in range(1, 12):
        assert found.check(100.0 + second, 185.0, 200, ON) is None
        assert found.error_ks == pytest.approx(10.0 * second)
    assert found.check(112.0, 185.0, 200, ON) == (
        "does not hold 200 °C: it fell to 185.0 °C (120 K·s below its range of 5 K); "
        "check heater, sensor and what cools them"
    )


def test_the_error_of_one_target_is_not_that_of_the_next() -> None:
    for new_target in (0.0, 180.0):
        found = holding()
        assert found.check(105.0, 185.0, 200, ON) is None
        assert found.error_ks == 50.0
        assert found.check(106.0, 185.0, new_target, ON) is None
        assert found.error_ks == 0.0
    assert found.check(107.0, 170.0, 180, ON) is None
    assert found.error_ks == 5.0, "180 °C were reached from above"
    found = holding()
    assert found.check(105.0, 185.0, 200, ON) is None
    assert found.check(106.0, 185.0, 210, ON) is None
    assert found.error_ks == 0.0


def test_after_it_was_off_the_range_has_to_be_reached_again() -> None:
    found = holding()
    assert found.check(101.0, 190.0, 0, ON) is None
    assert found.check(102.0, 190.0, 200, ON) is None
    assert found.check(103.0, 190.0, 200, ON) is None
    assert found.error_ks == 0.0


@pytest.mark.parametrize(
    ("now_s", "error_ks"), [(100.0, 0.0), (99.0, 0.0), (104.9, 49.0), (105.1, 50.0), (900.0, 50.0)]
)
def test_a_gap_counts_five_seconds_at_most_and_time_never_runs_back(now_s: float, error_ks: float) -> None:
    found = holding()
    assert found.check(now_s, 185.0, 200, ON) is None
    assert found.error_ks == pytest.approx(error_ks)


def test_the_first_look_takes_no_time() -> None:
    found = check()
    assert found.check(500.0, 200.0, 200, ON) is None
    assert found.error_ks == 0.0
    assert found.check(501.0, 194.0, 200, ON) is None
    assert found.error_ks == 1.0


# ----------------------------------------------------------------------------------------------- stuck switch


def off(until_s: float = 29.9, celsius: float = 40.0) -> HeaterCheck:
    """Return the check of a heater that has been off since 0 s and was at CELSIUS at UNTIL_S."""
    found = check()
    for now_s in (0.0, until_s):
        assert found.check(now_s, celsius, 0, OFF) is None
    return found


def test_a_rise_by_six_kelvin_is_a_stuck_switch_and_less_is_none() -> None:
    found = off()
    assert found.check(30.0, 45.9, 0, OFF) is None
    assert found.check(40.0, 46.0, 0, OFF) == (
        "heats though it is off: it rose from 40.0 to 46.0 °C in 10 s; its switch is stuck, cut its power"
    )


def test_within_its_first_thirty_seconds_off_it_may_rise() -> None:
    found = off()
    assert found.check(29.99, 90.0, 0, OFF) is None
    assert found.check(35.0, 95.9, 0, OFF) is None, "from where it was at 29.99 s"
    assert found.check(36.0, 96.0, 0, OFF) is not None


def test_at_thirty_seconds_it_is_no_longer_just_off() -> None:
    found = off(29.0)
    assert found.check(30.0, 46.0, 0, OFF) is not None


def test_a_slow_rise_is_none() -> None:
    found = off(29.0)
    assert found.check(49.0, 45.0, 0, OFF) is None, "20 s from the bottom"
    assert found.check(49.1, 46.5, 0, OFF) is None, "too long: it counts from here"
    assert found.check(60.0, 52.4, 0, OFF) is None
    assert found.check(61.0, 52.5, 0, OFF) is not None
    found = off(29.0)
    assert found.check(49.0, 46.0, 0, OFF) is not None, "20 s are within the time"


def test_it_counts_from_the_coolest() -> None:
    found = off(29.0)
    assert found.check(35.0, 42.0, 0, OFF) is None
    assert found.check(40.0, 40.0, 0, OFF) is None, "as cool as before: the time begins here"
    assert found.check(59.0, 45.9, 0, OFF) is None
    assert found.check(59.5, 46.0, 0, OFF) is not None


def test_power_between_begins_it_again() -> None:
    found = off(29.0)
    assert found.check(31.0, 40.0, 0, ON) is None
    assert found.check(32.0, 46.0, 0, OFF) is None
    assert found.check(61.9, 60.0, 0, OFF) is None
    assert found.check(62.1, 66.0, 0, OFF) is not None


def test_it_is_off_from_the_first_look_that_finds_it_off() -> None:
    found = check()
    assert found.check(0.0, 40.0, 0, ON) is None
    for now_s, celsius in ((10.0, 40.0), (31.0, 40.0), (39.9, 90.0)):
        assert found.check(now_s, celsius, 0, OFF) is None
    assert found.check(40.0, 96.0, 0, OFF) is not None


def test_a_heater_that_is_off_may_be_as_cold_as_it_likes() -> None:
    found = check()
    assert found.error_ks == 0.0
    for second in range(60):
        assert found.check(second, -20.0, 0, OFF) is None
    assert found.check(60.0, -20.0, 1.0, ON) is None, "the lowest target there is has to be approached"
    assert found.check(79.9, -20.0, 1.0, ON) is None
    assert found.check(80.0, -20.0, 1.0, ON) is not None


def test_a_first_target_is_approached_whatever_it_is() -> None:
    found = check()
    assert found.check(50.0, -20.0, 1.0, ON) is None


def test_a_stuck_switch_is_found_above_a_target_too() -> None:
    found = check()
    for now_s in (0.0, 29.9):
        assert found.check(now_s, 60.0, 50.0, OFF) is None
    fault = found.check(35.0, 66.0, 50.0, OFF)
    assert fault is not None
    assert "stuck" in fault
