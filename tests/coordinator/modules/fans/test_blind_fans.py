"""Fans whose sensor says nothing, or what cannot be: they cool, since nobody knows how hot it is."""

import asyncio
from pathlib import Path

import pytest

from coordinator.modules.fans.temperature_fan import TemperatureFan
from coordinator.modules.heaters.heater import LOOK_S, SILENT_LOOKS
from coordinator.modules.sensors.temperature_input import TemperatureInput
from nodes.virtual.plant_page import PlantFault, PlantItemKind
from tests.coordinator.modules.heaters.broken_sensor import Sensor
from tests.stages.heat_machine import HOTEND_PID, HeatMachine

SIDE = "temperature_fan bed_side"
SENSOR = "temperature_fan_bed_side"
FAN = (
    f"\n[{SIDE}]\npin: PC7\nsensor_type: Generic 3950\nsensor_pin: PC8\nmin_temp: 0\nmax_temp: 150\n"
    "target_temp: 60\nkick_start_time: 0\nmin_speed: 0.2\nmax_speed: 0.9\ncontrol: watermark\n"
)
HOTEND_FAN = "\n[heater_fan hotend]\npin: toolhead:PB5\nheater_temp: 20\nkick_start_time: 0\n"


@pytest.fixture
def stage(tmp_path: Path) -> HeatMachine:
    """Return a machine with a fan that has a target, and one that cools what is above 20 °C: the room is."""
    return HeatMachine(tmp_path, HOTEND_PID + FAN + HOTEND_FAN)


@pytest.mark.parametrize("fault", [PlantFault.OPEN, PlantFault.SHORTED])
def test_a_bad_measurement_is_neither_hot_nor_cold(stage: HeatMachine, fault: PlantFault) -> None:
    async def main() -> None:
        await asyncio.sleep(1.0)
        assert stage.status(SIDE)["speed"] == 0.2
        stage.fault(PlantItemKind.SENSOR, fault, SENSOR, "mcu")
        await asyncio.sleep(0.4)
        assert stage.status(SIDE)["speed"] == 0.9
        stage.fault(PlantItemKind.SENSOR, PlantFault.SOUND, SENSOR, "mcu")
        await asyncio.sleep(0.4)
        assert stage.status(SIDE)["speed"] == 0.2
        assert stage.machine.stopped is None

    stage.connected(main)


def test_a_fan_whose_sensor_is_silent_runs_at_its_highest_speed(stage: HeatMachine) -> None:
    async def main() -> None:
        await asyncio.sleep(1.0)
        module = stage.machine.modules.find(SIDE, TemperatureFan)
        assert module is not None
        assert isinstance(module.input, TemperatureInput)
        assert stage.machine.modules.controls, "its measurements may not wait"
        module.input._analog.stop(stage.machine.nodes["mcu"])
        await asyncio.sleep((SILENT_LOOKS + 2) * LOOK_S)
        assert stage.status(SIDE)["speed"] == 0.9
        await asyncio.sleep(5.0)
        (notice,) = [text for text in stage.notices if "highest speed" in text]
        assert notice.startswith(f"[{SIDE}] runs at its highest speed: its sensor is silent; check")
        await stage.do("SET_TEMPERATURE_FAN_TARGET TEMPERATURE_FAN=bed_side TARGET=0")
        await asyncio.sleep(2.0)
        assert stage.status(SIDE)["speed"] == 0
        assert not stage.machine.modules.controls

    stage.connected(main)


def test_a_fan_whose_measurements_cannot_be_handled_runs_at_its_highest_speed(stage: HeatMachine) -> None:
    """Failed before: it kept the speed that it had."""

    class Broken:
        def power(self, *_: float) -> float:
            raise ZeroDivisionError

    async def main() -> None:
        asyncio.get_running_loop().set_exception_handler(lambda *_: None)
        await asyncio.sleep(1.0)
        module = stage.machine.modules.find(SIDE, TemperatureFan)
        assert module is not None
        module._controller = Broken()  # type: ignore[assignment]
        await asyncio.sleep((SILENT_LOOKS + 2) * LOOK_S)
        assert stage.status(SIDE)["speed"] == 0.9
        await asyncio.sleep(5.0)
        (notice,) = [text for text in stage.notices if "highest speed" in text]
        assert notice.endswith("its measurements cannot be handled; this is a bug, please report it")

    stage.connected(main)


def test_a_hotends_fan_is_not_stopped_by_a_torn_wire(stage: HeatMachine) -> None:
    async def main() -> None:
        sensor = Sensor(stage)
        await sensor.good(6)
        assert stage.status("heater_fan hotend")["speed"] == 1
        await sensor.bad(3)
        await asyncio.sleep(0.1)
        assert stage.status("heater_fan hotend")["speed"] == 1

    stage.connected(main)
