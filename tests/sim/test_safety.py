"""What ends with the heaters off while the machine moves; the other cases are in test_heat_safety.py."""

from dataclasses import replace

import pytest

from tests.sim.safety.cases import _judged, cases, main, run
from tests.stages.safety_rig import Found, HeaterFound

CASES = {case.name: case for case in cases()}
QUIET = Found(
    heaters=(HeaterFound("extruder", was_on=True, off_after_s=1.2),),
    last_step_after_s=0.0,
    steps_after=0,
    stopped_after_s=1.3,
    told="node toolhead shut down: ADC out of range",
)
OPEN = replace(CASES["sensor open"], bounds_s={"extruder": 1.5})


@pytest.mark.parametrize(
    "name",
    [
        "emergency stop, homing",
        "node lost, printing",
        "node lost, homing",
        "host gone, homing",
        "host stalls 2 s, printing",
        "host's Python stalls 2 s, printing",
    ],
)
def test_heaters_are_off_in_time_and_motors_stand(name: str) -> None:
    rows = run(CASES[name])
    assert {row.heater for row in rows} == {"extruder", "heater_bed"}
    assert all(row.ok for row in rows), rows


def test_the_command_prints_the_table(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--case", "sensor shorted"]) == 0
    head, hotend, bed = capsys.readouterr().out.splitlines()
    assert "off after" in head
    assert hotend.split()[:3] == ["sensor", "shorted", "extruder"]
    assert "ok  node toolhead shut down: ADC out of range" in bed


@pytest.mark.parametrize(
    ("found", "ok"),
    [
        (QUIET, True),
        (replace(QUIET, heaters=(HeaterFound("extruder", was_on=True, off_after_s=1.6),)), False),
        (replace(QUIET, heaters=(HeaterFound("extruder", was_on=True, off_after_s=float("inf")),)), False),
        (replace(QUIET, heaters=(HeaterFound("extruder", was_on=False, off_after_s=0.0),)), False),
        (replace(QUIET, told="the user cancelled"), False),
        (replace(QUIET, steps_after=1, last_step_after_s=0.01), False),
    ],
)
def test_a_case_is_bad_that_shows_nothing_or_comes_too_late(found: Found, ok: bool) -> None:
    (row,) = [_judged(OPEN, found, "extruder")]
    assert row.ok is ok


def test_motors_that_go_on_for_too_long_are_bad() -> None:
    case = replace(OPEN, steps_s=0.02)
    assert _judged(case, replace(QUIET, steps_after=9, last_step_after_s=0.019), "extruder").ok
    assert not _judged(case, replace(QUIET, steps_after=9, last_step_after_s=0.021), "extruder").ok
