"""The watch over a heater whose target changes all the time: it is not put off by that."""

import pytest

from coordinator.heat.verify import HeaterCheck, VerifyOptions

OPTIONS = VerifyOptions()
REPORT_S = 0.3


def watch(measured_c: float, k_per_s: float, targets: tuple[float, ...], every_s: float) -> float | None:
    """Return when the watch finds a fault in a temperature that changes by so much, within 10 min; else None.

    The target is each of TARGETS in turn, for EVERY_S.
    """
    check, now_s = HeaterCheck(OPTIONS), 0.0
    while now_s < 600:
        target_c = targets[int(now_s / every_s) % len(targets)]
        if check.check(now_s, measured_c + k_per_s * now_s, target_c, 1.0) is not None:
            return now_s
        now_s += REPORT_S
    return None


@pytest.mark.parametrize("every_s", [0.3, 5.0, 19.0])
@pytest.mark.parametrize("targets", [(200.0, 201.0), (200.0, 240.0), (200.0, 199.0, 198.0, 199.0)])
@pytest.mark.parametrize("k_per_s", [0.0, -0.1, 0.05])
def test_a_heater_that_does_not_heat_is_found_in_spite_of_new_targets(
    targets: tuple[float, ...], every_s: float, k_per_s: float
) -> None:
    """Also one whose sensor fell out: at full power."""
    found_s = watch(120.0, k_per_s, targets, every_s)
    assert found_s is not None
    assert found_s <= OPTIONS.check_gain_s + REPORT_S


@pytest.mark.parametrize("every_s", [0.3, 5.0, 19.0])
def test_a_heater_that_heats_is_left_in_peace(every_s: float) -> None:
    assert watch(25.0, 0.3, (200.0, 201.0), every_s) is None


def test_after_holding_one_target_another_one_has_all_its_time() -> None:
    check = HeaterCheck(OPTIONS)
    for second in range(100):
        assert check.check(second, 200.0, 200.0, 0.4) is None
    for second in range(100, 119):
        assert check.check(second, 200.0, 240.0, 1.0) is None
    assert check.check(121.0, 200.0, 240.0, 1.0) is not None


def test_a_heater_that_was_switched_off_begins_from_where_it_is() -> None:
    check = HeaterCheck(OPTIONS)
    for second in range(15):
        assert check.check(second, 100.0, 200.0, 1.0) is None
    assert check.check(15, 100.0, 0.0, 0.0) is None
    for second in range(16, 35):
        assert check.check(second, 100.0, 200.0, 1.0) is None
    assert check.check(37, 100.0, 200.0, 1.0) is not None


def test_another_target_below_a_degree_gains_no_time_either() -> None:
    check = HeaterCheck(OPTIONS)
    assert check.check(0.0, -20.0, 1.0, 1.0) is None
    assert check.check(15.0, -20.0, 0.5, 1.0) is None
    assert check.check(20.0, -20.0, 0.5, 1.0) is not None
