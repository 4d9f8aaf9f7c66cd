"""Outputs that programs set, and outputs that just have a value."""

import asyncio
import itertools
import re
from pathlib import Path

import pytest

from coordinator.assembly.check import check_config
from coordinator.gcode.parser import WordError
from tests.stages.heat_machine import BASE, HOTEND_PID, HeatMachine, build, configured

LAMP = "\n[output_pin lamp]\npin: !PC5\nvalue: 1\n"
SOFT = (
    "\n[output_pin soft]\npin: PC6\npwm: True\nscale: 10\ncycle_time: 0.01\nvalue: 2.5\nshutdown_value: 10\n"
)
HARD = (
    "\n[output_pin hard]\npin: PC7\npwm: True\nhardware_pwm: True\ncycle_time: 0.001\nshutdown_value: 0.25\n"
)


def test_an_output_is_set_at_its_place_among_the_moves(tmp_path: Path) -> None:
    stage = HeatMachine(tmp_path, HOTEND_PID + LAMP)
    stage.print("SET_PIN PIN=lamp VALUE=0", "G4 P3000", "SET_PIN PIN=LAMP VALUE=1", "G4 P1000")
    edges = stage.edges("PC5", "mcu")
    assert [level for _, level in edges] == [1, 0], "it is inverted, and began on: low"
    assert edges[1][0] - edges[0][0] == pytest.approx(3, abs=0.2)


def test_a_digital_output_has_its_values(tmp_path: Path) -> None:
    stage = HeatMachine(tmp_path, HOTEND_PID + LAMP)

    async def main() -> None:
        assert stage.status("output_pin lamp")["value"] == 1
        await stage.do("SET_PIN PIN=lamp VALUE=0")
        assert stage.status("output_pin lamp")["value"] == 0
        for line, why in (
            ("SET_PIN PIN=lamp VALUE=0.5", "must be 0 or 1; with pwm"),
            ("SET_PIN PIN=lamp", "needs VALUE="),
            ("SET_PIN PIN=lmap VALUE=1", "there is no 'lmap'; did you mean lamp"),
        ):
            with pytest.raises(WordError, match=why):
                stage.read(line)

    stage.connected(main)


def test_pwm_by_software_begins_where_it_is_told_to_and_ends_at_its_shutdown(tmp_path: Path) -> None:
    stage = HeatMachine(tmp_path, HOTEND_PID + SOFT)

    def on_part() -> float:
        edges = [edge for edge in stage.edges("PC6", "mcu") if edge[0] > stage.now_s() - 0.5]
        spans = [(b[0] - a[0], a[1]) for a, b in itertools.pairwise(edges)]
        return sum(span for span, level in spans if level) / sum(span for span, _ in spans)

    async def main() -> None:
        await asyncio.sleep(2)
        assert on_part() == pytest.approx(0.25, abs=0.02)
        await stage.do("SET_PIN PIN=soft VALUE=7")
        await asyncio.sleep(2)
        assert on_part() == pytest.approx(0.7, abs=0.02)
        assert stage.status("output_pin soft")["value"] == 7
        with pytest.raises(WordError, match="must be 0 to 10"):
            stage.read("SET_PIN PIN=soft VALUE=11")
        stage.machine.stop("for the test")
        await asyncio.sleep(1)
        assert stage.edges("PC6", "mcu")[-1][1] == 1

    stage.connected(main)


def test_pwm_by_hardware(tmp_path: Path) -> None:
    modules = build(tmp_path, HOTEND_PID + HARD.replace("[output_pin hard]", "[output_pin hard]\nvalue: 0.5"))
    (command,) = [line for line in configured(modules, "mcu") if line.startswith("config_pwm_out")]
    assert command.endswith("value=16384 default_value=8192 max_duration=0")


def test_static_outputs_are_switched_at_the_start(tmp_path: Path) -> None:
    stage = HeatMachine(
        tmp_path, HOTEND_PID + "\n[static_digital_output jumpers]\npins: PC5, !PC6, toolhead:PC7\n"
    )

    async def main() -> None:
        await asyncio.sleep(1)
        assert [level for _, level in stage.edges("PC5", "mcu")] == [1]
        assert stage.edges("PC6", "mcu") == []
        assert [level for _, level in stage.edges("PC7")] == [1]
        stage.machine.stop("for the test")
        await asyncio.sleep(1)
        assert [level for _, level in stage.edges("PC5", "mcu")] == [1], "it stays so"

    stage.connected(main)


@pytest.mark.parametrize(
    ("text", "wrong"),
    [
        (LAMP.replace("value: 1", "value: 0.5"), "option 'value' of .* is '0.5', which must be 0 or 1"),
        (SOFT.replace("value: 2.5", "value: 12"), "'value' of .* is '12', which must be 0 to 10"),
        (SOFT.replace("shutdown_value: 10", "shutdown_value: 5"), "'shutdown_value'.* needs hardware_pwm"),
        (LAMP + "cycle_time: 1\n", "'cycle_time' of .* has no effect with the others"),
        (LAMP.replace("!PC5", "PA1"), "PA1.* 'step_pin' of \\[stepper_x\\]"),
        ("\n[static_digital_output x]\npins: PC5, ^PC6\n", "'pins' of .* which is an output; remove the"),
        (
            "\n[static_digital_output x]\npins: PC5\n[output_pin y]\npin: PC5\n",
            "'pins' of \\[static_digital_output x\\]",
        ),
    ],
)
def test_mistakes(tmp_path: Path, text: str, wrong: str) -> None:
    path = tmp_path / "printer.cfg"
    path.write_text(BASE + HOTEND_PID + text)
    found = " ".join(map(str, check_config(str(path))))
    assert re.search(wrong, found), found


def test_query_adc_tells_what_converters_read(tmp_path: Path) -> None:
    stage = HeatMachine(tmp_path, HOTEND_PID)

    async def main() -> None:
        assert (await stage.do("QUERY_ADC"))[0] == "sensors with a converter: extruder"
        told = (await stage.do("QUERY_ADC NAME=extruder PULLUP=4700"))[0]
        found = re.fullmatch(r"extruder: (0\.\d+) of full scale, with 4700 Ω above it (\d+\.\d) Ω", told)
        assert found is not None
        assert float(found[1]) == pytest.approx(100_000 / 104_700, abs=0.002)
        assert float(found[2]) == pytest.approx(100_000, rel=0.04), "a thermistor of 100 kΩ at 25 °C"
        with pytest.raises(WordError, match="there is no 'x'"):
            stage.read("QUERY_ADC NAME=x")

    stage.connected(main)
