"""Measurements that cannot be: no heat while they come, and no stop because of single ones far apart."""

import asyncio
from pathlib import Path

import pytest

from coordinator.modules.heaters.heater import BAD_MEASUREMENTS
from coordinator.modules.outputs.timing import AHEAD_S
from coordinator.modules.sensors.temperature_sensor import TemperatureSensor
from coordinator.modules.sensors.temperature_source import BAD_IN_A_ROW
from nodes.devices.analog_in import RANGE_CHECKS
from nodes.support.errors import CanductorError
from nodes.virtual.plant_page import PlantFault
from tests.coordinator.modules.heaters.broken_sensor import Sensor
from tests.stages.heat_machine import HOTEND_PID, HeatMachine

REPORT_S = 0.3
"""Between two measurements."""
SLACK_S = 0.03
"""Of sampling, wires and the host."""
COLD = "\n[temperature_sensor computer]\nsensor_type: temperature_host\nmin_temp: 10\nmax_temp: 90\n"


def off_times(stage: HeatMachine, since_s: float) -> list[tuple[float, float]]:
    """Return when the heater's pin was low since then, counted from then: from, to."""
    changes = [(at - since_s, level) for at, level in stage.edges("PB3") if at > since_s]
    ends = [at for at, _ in changes[1:]]
    return [(at, end) for (at, level), end in zip(changes, ends, strict=False) if not level]


def test_one_bad_measurement_ends_the_heat_until_the_next_good_one(tmp_path: Path) -> None:
    """While it heats up at full power; its node alone would have gone on until max_duration."""
    stage = HeatMachine(tmp_path, HOTEND_PID)

    async def main() -> None:
        await stage.do("M104 S250")
        sensor = Sensor(stage)
        await sensor.good(5)
        for fault in (PlantFault.OPEN, PlantFault.SHORTED):
            since_s = stage.now_s()
            await sensor.bad(1, fault)
            bad_s = stage.now_s() - since_s
            await sensor.good(5)
            (off,) = off_times(stage, since_s)
            assert bad_s <= REPORT_S + SLACK_S
            assert abs(off[0] - bad_s - AHEAD_S) < SLACK_S
            assert abs(off[1] - off[0] - REPORT_S) < SLACK_S
        assert stage.machine.stopped is None

    stage.connected(main)


def test_bad_measurements_far_apart_do_not_add_up(tmp_path: Path) -> None:
    stage = HeatMachine(tmp_path, HOTEND_PID)

    async def main() -> None:
        await stage.do("M104 S250")
        sensor = Sensor(stage)
        for _ in range(BAD_MEASUREMENTS + 2):
            await sensor.good(1)
            await sensor.bad(RANGE_CHECKS - 1)
        await sensor.good(2)
        assert stage.machine.stopped is None
        assert sensor.unit.power > 0
        assert stage.status("extruder")["target"] == 250

    stage.connected(main)


@pytest.mark.parametrize("control", [HOTEND_PID, "control: watermark\n"])
def test_a_bad_measurement_ends_no_wait_and_allows_no_filament(tmp_path: Path, control: str) -> None:
    """A shorted thermistor looks hotter than any target."""
    stage = HeatMachine(tmp_path, control)

    async def main() -> None:
        sensor = Sensor(stage)
        lines = ("M109 S200", "TEMPERATURE_WAIT SENSOR=extruder MINIMUM=200")
        waiting = [asyncio.ensure_future(stage.do(line)) for line in lines]
        await sensor.good(3)
        await sensor.bad(2, PlantFault.SHORTED)
        await asyncio.sleep(0)
        assert not stage.status("extruder")["can_extrude"]
        assert not any(wait.done() for wait in waiting)
        for wait in waiting:
            wait.cancel()

    stage.connected(main)


def test_a_bad_measurement_does_not_make_a_hot_nozzle_cold(tmp_path: Path) -> None:
    """A torn wire looks colder than any room; a program that prints is not refused for one such look."""
    stage = HeatMachine(tmp_path, HOTEND_PID + "min_extrude_temp: 20\n")

    async def main() -> None:
        sensor = Sensor(stage)
        assert stage.status("extruder")["can_extrude"]
        await sensor.bad(1)
        assert stage.status("extruder")["can_extrude"]

    stage.connected(main)


def test_a_sensor_that_no_node_watches_stops_the_machine_by_bad_ones_in_a_row_only(tmp_path: Path) -> None:
    path = tmp_path / "computer"
    stage = HeatMachine(tmp_path, HOTEND_PID + COLD + f"sensor_path: {path}\n")
    path.write_text("40000")

    async def main() -> None:
        module = stage.machine.modules.find("temperature_sensor computer", TemperatureSensor)
        assert module is not None
        source = module.input
        for _ in range(BAD_IN_A_ROW + 2):
            path.write_text("40000")
            await source.next()
            path.write_text("140000")
            await source.next()
        assert stage.machine.stopped is None
        for _ in range(BAD_IN_A_ROW - 2):
            await source.next()
            assert stage.machine.stopped is None
        with pytest.raises(CanductorError, match=r"\[temperature_sensor computer\] reads 140 °C"):
            await source.next()

    stage.connected(main)
