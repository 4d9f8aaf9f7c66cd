"""Homing finds the same place again: with clocks of any offset and rate, on a bus that loses frames."""

import pytest

from tests.sim.homings import MICROSTEP_MM, home_repeatedly, main, report, spread_mm


def test_homing_repeats_within_a_microstep_with_any_clocks_and_lost_frames() -> None:
    homings = [homing for seed in range(1, 4) for homing in home_repeatedly(seed, times=9)]
    assert len(homings) == 54
    for axis in "xy":
        assert spread_mm(homings, axis) < MICROSTEP_MM, report(homings)
        # A step comes when half of it is due; at 60 mm/s a look is 3 µm late at most, a step 0.75 µm early,
        # and clocks that differ by 50 µs are 3 µm.
        assert all(-MICROSTEP_MM / 2 - 0.004 < h.error_mm < 0.003 for h in homings), report(homings)


def test_the_command_prints_the_spread(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--seeds", "5:6", "--loss", "0"]) == 0
    head, x, y = capsys.readouterr().out.splitlines()
    assert "spread" in head
    assert x.split()[:3] == ["x", "1", "1"]
    assert y.split()[0] == "y"
