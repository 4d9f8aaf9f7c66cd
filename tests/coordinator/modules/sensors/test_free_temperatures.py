"""Temperatures of chips, of the host and of several sensors together."""

import asyncio
import re
from pathlib import Path

import pytest

from coordinator.assembly.check import check_config
from coordinator.support.values import Value
from nodes.support.errors import CanductorError
from tests.stages.heat_machine import BASE, BED, HOTEND_PID, HeatMachine

CHIP = "\n[temperature_sensor board]\nsensor_type: temperature_mcu\nsensor_mcu: toolhead\n"
BOTH = (
    "\n[temperature_sensor both]\nsensor_type: temperature_combined\n"
    "sensor_list: extruder, heater_bed\ncombination_method: {method}\n"
)


def host(folder: Path, text: str = "48312\n") -> str:
    (folder / "temp").write_text(text)
    return f"\n[temperature_sensor computer]\nsensor_type: temperature_host\nsensor_path: {folder}/temp\n"


def test_a_boards_chip_is_measured(tmp_path: Path) -> None:
    stage = HeatMachine(tmp_path, HOTEND_PID + CHIP + "gcode_id: C\n")

    async def main() -> None:
        assert stage.status("temperature_sensor board")["temperature"] == pytest.approx(35, abs=0.3)
        assert "C:35" in (await stage.do("M105"))[0]
        await stage.do('TEMPERATURE_WAIT SENSOR="temperature_sensor board" MINIMUM=30')

    stage.connected(main)


def test_two_points_of_ones_own_correct_it(tmp_path: Path) -> None:
    own = "sensor_temperature1: 20\nsensor_adc1: 0.2\nsensor_temperature2: 60\nsensor_adc2: 0.22\n"
    stage = HeatMachine(tmp_path, HOTEND_PID + CHIP + own)

    async def main() -> None:
        expected = 20 + (859 / 4095 - 0.2) / 0.02 * 40
        assert stage.status("temperature_sensor board")["temperature"] == pytest.approx(expected, abs=0.1)

    stage.connected(main)


def test_the_host_is_looked_at_again_and_again(tmp_path: Path) -> None:
    stage = HeatMachine(tmp_path, HOTEND_PID + host(tmp_path))

    def told() -> Value:
        return stage.status("temperature_sensor computer")["temperature"]

    async def main() -> None:
        assert told() == 48.31
        (tmp_path / "temp").write_text("51000")
        await stage.do('TEMPERATURE_WAIT SENSOR="temperature_sensor computer" MINIMUM=50')
        assert told() == 51
        (tmp_path / "temp").write_text("nonsense")
        await asyncio.sleep(5)
        assert told() is None
        assert len([text for text in stage.notices if "holds 'nonsense'" in text]) == 1
        (tmp_path / "temp").write_text("40000")
        await asyncio.sleep(2)
        assert told() == 40
        assert stage.status("temperature_sensor computer")["measured_max_temp"] == 51

    stage.connected(main)


def test_a_host_without_the_file_is_told_so(tmp_path: Path) -> None:
    stage = HeatMachine(tmp_path, HOTEND_PID + host(tmp_path).replace("/temp\n", "/none\n"))

    async def main() -> None:
        pytest.fail("it started")

    with pytest.raises(CanductorError, match=r"none cannot be read: No such file.*correct sensor_path"):
        stage.connected(main)


def test_a_host_that_is_too_hot_stops_the_machine(tmp_path: Path) -> None:
    stage = HeatMachine(tmp_path, HOTEND_PID + host(tmp_path) + "max_temp: 80\n")

    async def main() -> None:
        (tmp_path / "temp").write_text("81000")
        assert "reads 81 °C, outside its min_temp" in await stage.stopped(20)

    stage.connected(main)


def test_a_wait_for_a_temperature_can_be_ended(tmp_path: Path) -> None:
    stage = HeatMachine(tmp_path, HOTEND_PID + BED)

    async def main() -> None:
        waits = asyncio.create_task(stage.do("TEMPERATURE_WAIT SENSOR=heater_bed MINIMUM=100"))
        await asyncio.sleep(3)
        assert not waits.done()
        await stage.do("HEATER_INTERRUPT")
        await asyncio.wait_for(waits, 2)
        later = asyncio.create_task(stage.do("TEMPERATURE_WAIT SENSOR=heater_bed MINIMUM=100"))
        await asyncio.sleep(3)
        assert not later.done(), "it counts for the one that waits only"
        later.cancel()

    stage.connected(main)


@pytest.mark.parametrize(("method", "expected"), [("min", 25), ("max", 41), ("mean", 33)])
def test_several_sensors_become_one(tmp_path: Path, method: str, expected: float) -> None:
    stage = HeatMachine(tmp_path, HOTEND_PID + BED + BOTH.format(method=method), hurry=10)

    async def main() -> None:
        await stage.do("TEMPERATURE_WAIT SENSOR=heater_bed MAXIMUM=26")
        await stage.do("M140 S40")
        await stage.do("TEMPERATURE_WAIT SENSOR=heater_bed MINIMUM=41")
        await asyncio.sleep(0.4)
        found = stage.status("temperature_sensor both")["temperature"]
        assert isinstance(found, float)
        assert found == pytest.approx(expected, abs=3)

    stage.connected(main)


def test_sensors_that_are_too_far_apart_stop_the_machine(tmp_path: Path) -> None:
    stage = HeatMachine(
        tmp_path, HOTEND_PID + BED + BOTH.format(method="max") + "maximum_deviation: 8\n", hurry=10
    )

    async def main() -> None:
        await stage.do("M140 S60")
        stopped = await stage.stopped(60)
        assert "K apart, more than maximum_deviation (8 K): extruder 25" in stopped

    stage.connected(main)


def test_a_combined_sensor_waits_for_all_of_them(tmp_path: Path) -> None:
    stage = HeatMachine(
        tmp_path,
        HOTEND_PID
        + host(tmp_path, "20000")
        + BED
        + BOTH.format(method="min").replace(
            "extruder, heater_bed", "heater_bed, temperature_sensor computer"
        ),
    )

    async def main() -> None:
        await asyncio.sleep(1)
        assert stage.status("temperature_sensor both")["temperature"] == 20
        (tmp_path / "temp").write_text("")
        await asyncio.sleep(3)
        assert stage.status("temperature_sensor both")["temperature"] is None

    stage.connected(main)


@pytest.mark.parametrize(
    ("text", "wrong"),
    [
        (CHIP.replace("toolhead", "toolhaed"), "option 'sensor_mcu'.*no node 'toolhaed'; did you mean"),
        (CHIP + "sensor_pin: PA7\n", "option 'sensor_pin'.*has no effect with the others"),
        (CHIP + "sensor_adc1: 0.2\n", "needs all of sensor_temperature1"),
        (BOTH.format(method="median"), "option 'combination_method'.*min, max"),
        (
            BOTH.format(method="min").replace("heater_bed", "bed"),
            "'sensor_list'.*names 'bed', which does not exist",
        ),
        (
            BOTH.format(method="min").replace("heater_bed", "temperature_sensor both"),
            "names this section itself",
        ),
        (
            BED.replace("Generic 3950", "temperature_host"),
            "no node can check: a heater needs a sensor on a pin",
        ),
        (BED + "sensor_path: /x\n", r"\[heater_bed\] has no option 'sensor_path'"),
    ],
)
def test_mistakes(tmp_path: Path, text: str, wrong: str) -> None:
    path = tmp_path / "printer.cfg"
    path.write_text(BASE + HOTEND_PID + text)
    found = " ".join(map(str, check_config(str(path))))
    assert re.search(wrong, found), found
