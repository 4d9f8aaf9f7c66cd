"""[bltouch] on a virtual bed: a virtual BLTouch decodes the servo's signal, moves its pin, and fails.

What was sent is decoded here again, from the edges of the control pin, by the data sheet's lengths.
"""

import re
from itertools import groupby
from pathlib import Path
from typing import Any

import pytest

from coordinator.virtual_machine.plant_bed import BedSettings
from nodes.virtual.plant import Bed
from nodes.virtual.plant_page import PlantFault
from tests.profiles import is_full
from tests.stages.probe_stage import MICROSTEP_MM, OFFSET, ProbeStage, heights, machine_text

TILTED = BedSettings(shape=Bed(z=0.2, x0=100, y0=100, tilt_x=0.002, tilt_y=-0.001))
LENGTHS_US = {
    647: "down",
    1162: "touch",
    1475: "up",
    1782: "self-test",
    1884: "store",
    1988: "5V",
    2091: "OD",
    2194: "reset",
}
WAY = ["down", "up", "touch", "up"]
"""One way down: at its end touch mode shows that the pin is up."""
SEE = "[gcode_macro SEE]\ngcode:\n  M118 {printer.probe.name} {printer.probe.last_query}\n"


def stage_of(folder: Path, **options: Any) -> ProbeStage:
    folder.mkdir(exist_ok=True)
    text = machine_text(z={"homing_retract_dist": 0}, kind="bltouch", **options)
    return ProbeStage(folder, text, bed=TILTED)


def sent(stage: ProbeStage) -> list[tuple[float, str]]:
    """Return when each command began, s, and which it is; every single pulse has the length of one."""
    pulses: list[tuple[float, str]] = []
    rise = None
    for at, level in stage.edges("PB0", "toolhead"):
        if level:
            rise = at
        elif rise is not None:
            us = (at - rise) * 1e6
            known = min(LENGTHS_US, key=lambda length: abs(length - us))
            assert us == pytest.approx(known, abs=2), "a pulse was cut"
            pulses.append((rise, LENGTHS_US[known]))
    return [next(same) for _, same in groupby(pulses, key=lambda pulse: pulse[1])]


def names(stage: ProbeStage) -> list[str]:
    return [name for _, name in sent(stage)]


def refusal(stage: ProbeStage, *lines: str) -> str:
    with pytest.raises(Exception, match=r".") as error:
        stage.do(*lines)
    return str(error.value)


def rest_fault(stage: ProbeStage, fault: PlantFault) -> tuple[str, ...]:
    """Return the lines that home, lift the head to 6 mm, and let it fail while it stands there."""
    stage.on_echo["now"] = lambda: stage.fault(fault)
    return ("G28", "G1 Z6 F900", "M400", "M118 now")


def touch_fault(stage: ProbeStage, fault: PlantFault, after_s: float) -> tuple[str, ...]:
    """Return the lines that home, and probe from 6 mm, on whose way down at 3 mm it fails, AFTER_S later."""
    stage.on_echo["now"] = lambda: stage.when(
        lambda: stage.true_mm("z") < 3, lambda: stage.at(after_s, lambda: stage.fault(fault)), look_s=0.02
    )
    return ("G28", "G1 Z6 F900", "M400", "M118 now", "PROBE")


def test_it_homes_and_measures_with_its_pin_checked_each_time(tmp_path: Path) -> None:
    stage = stage_of(tmp_path, sections=SEE)
    output = stage.do(
        *("G28", "G1 Z6 F900", "G1 X60 Y30 F6000", "PROBE SAMPLES=2 SAMPLE_RETRACT_DIST=1", "QUERY_PROBE"),
        *("BLTOUCH_DEBUG COMMAND=touch_mode", "QUERY_PROBE", "SEE"),
        *("G1 Z6", "BLTOUCH_DEBUG COMMAND=PIN_DOWN", "G4 P400", "QUERY_PROBE", "BLTOUCH_DEBUG COMMAND=reset"),
        *("BLTOUCH_DEBUG COMMAND=self_test", "BLTOUCH_STORE MODE=od", "M400"),
    )
    exact = OFFSET[2] + stage.trigger_z(60, 30) - stage.trigger_z(0, 0)
    assert heights(output) == [pytest.approx(exact, abs=MICROSTEP_MM)] * 2
    queries = [text for text in output if text.startswith("probe: ")]
    assert queries == ["probe: open", "probe: TRIGGERED", "probe: open"], "touch mode shows the raised pin"
    assert "echo: bltouch True" in output
    debugged = ["touch", "down", "reset", "self-test", "OD", "store", "OD", "up"]
    assert names(stage) == ["up", *WAY * 3, *debugged], "G28, two samples"
    downs = [at for at, name in sent(stage) if name == "down"]
    ups = [at for at, name in sent(stage) if name == "up"]
    assert min(step for step, level in stage.edges("PB6", "mcu") if level) > downs[0] + 0.680
    assert ups[2] - ups[1] > 0.680 + 0.1, "pin_move_time, and touch mode"
    unknown = refusal(stage_of(tmp_path), "BLTOUCH_DEBUG COMMAND=up")
    assert "COMMAND of BLTOUCH_DEBUG is 'up'; one of pin_down, touch_mode, pin_up, self_test" in unknown


def test_it_may_stay_down_between_samples_and_tell_less(tmp_path: Path) -> None:
    """Also its other options, each by what is sent."""
    options: dict[str, Any] = {"stow_on_each_sample": False, "pin_up_touch_mode_reports_triggered": False}
    stage = stage_of(tmp_path, pin_move_time=0.5, set_output_mode="5V", **options)
    lines = ("G28", "G1 Z6 F900", "PROBE SAMPLES=3 SAMPLE_RETRACT_DIST=1")
    assert len(heights(stage.do(*lines))) == 3
    # It went up by itself at each touch: a short pin_up makes pin_down a new command.
    assert names(stage) == ["5V", "up", "down", "up", "down", *["up", "down"] * 2, "up"]
    times = [at for at, _ in sent(stage)]
    assert times[-4] - times[-5] < 0.5 < times[3] - times[2]
    stage = stage_of(tmp_path / "touch", probe_with_touch_mode=True, **options)
    assert len(heights(stage.do(*lines))) == 3
    homed = ["down", "touch", "up"]
    assert names(stage)[: 1 + len(homed)] == ["up", *homed]
    assert names(stage)[1 + len(homed) :] == ["down", "touch", "down", "touch", "down", "touch", "up"]


@pytest.mark.parametrize("genuine", [True, False] if is_full() else [False])
def test_a_copy_may_show_its_raised_pin_as_triggered(tmp_path: Path, genuine: bool) -> None:
    """From half a second behind the touch on, the sensor is triggered."""
    stage = stage_of(tmp_path, pin_up_reports_not_triggered=genuine)
    lines = touch_fault(stage, PlantFault.ALWAYS, 0.8)
    if not genuine:
        assert len(heights(stage.do(*lines))) == 1
        return
    said = refusal(stage, *lines)
    assert "PROBE failed: the BLTouch did not raise its pin: 3 times its sensor was triggered" in said
    assert "pin_up_reports_not_triggered: False" in said
    assert re.search(r"; Z is 1\.\d+ mm$", said)


def test_a_pin_that_does_not_come_down_is_noticed_before_anything_moves(tmp_path: Path) -> None:
    stage = stage_of(tmp_path)
    said = refusal(stage, *rest_fault(stage, PlantFault.STUCK), "PROBE")
    assert "PROBE failed: the BLTouch did not lower its pin: 3 times its sensor was triggered" in said
    assert re.search(r"; Z is (6\.000|5\.999) mm$", said)
    assert names(stage)[-9:] == ["down", "reset", "up"] * 3
    assert stage.true_mm("z") == pytest.approx(6 - OFFSET[2] + stage.trigger_z(0, 0), abs=0.01)

    stage = stage_of(tmp_path)
    stage.fault(PlantFault.STUCK)
    said = refusal(stage, "G28")
    assert "Z was not homed: the BLTouch did not lower its pin" in said
    assert said.endswith("; the head was lowered by 0.000 mm")


def test_an_alarm_is_reset_and_the_pin_lowered_again(tmp_path: Path) -> None:
    stage = stage_of(tmp_path)
    stage.fault(PlantFault.STUCK)
    stage.when(lambda: "reset" in names(stage), lambda: stage.fault(PlantFault.SOUND), look_s=0.3)
    stage.do("G28")
    assert names(stage) == ["up", "down", "reset", "up", *WAY]


@pytest.mark.skipif(not is_full(), reason="thorough only: much as a pin that does not come down")
def test_a_pin_that_stays_down_is_noticed(tmp_path: Path) -> None:
    stage = stage_of(tmp_path)
    said = refusal(stage, *touch_fault(stage, PlantFault.STUCK, 0.0))
    assert "PROBE failed: the BLTouch did not raise its pin: 3 times" in said


def test_without_a_touch_the_pin_is_raised_all_the_same(tmp_path: Path) -> None:
    stage = stage_of(tmp_path)
    said = refusal(stage, *rest_fault(stage, PlantFault.NEVER), "PROBE")
    assert "PROBE failed: the probe did not trigger within" in said
    assert re.search(r"; Z is -3\.\d+ mm$", said)
    assert names(stage)[-1] == "up"
