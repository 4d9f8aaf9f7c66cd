"""A sensor that falls silent while its heater is held or calibrated: the heat ends, and it is told why."""

import asyncio
from collections.abc import Awaitable, Callable
from pathlib import Path

import pytest

from coordinator.modules.heaters.heater import LOOK_S, SILENT_LOOKS
from nodes.support.errors import CanductorError
from tests.coordinator.modules.heaters.broken_sensor import Sensor
from tests.stages.heat_machine import HOTEND_PID, HeatMachine

LIMIT_S = 1.5
"""max_duration, as it is without the option."""
NOTICED_S = (SILENT_LOOKS + 2) * LOOK_S
LOST_S = 2.5
"""Within this the host has given up on a node that is silent, and has looked for it."""
BOX = """
[mcu box]
canbus_uuid: 0123456789ad
canbus_interface: can0
policy: optional

[heater_generic chamber]
heater_pin: PC3
sensor_type: Generic 3950
sensor_pin: box:PA2
min_temp: 0
max_temp: 100
control: watermark
heater_power: 200
"""
CALIBRATIONS = [
    "PID_CALIBRATE HEATER={} TARGET={}",
    "MPC_CALIBRATE HEATER={} TARGET={} FAN_BREAKPOINTS=2",
]


async def is_on(sensor: Sensor) -> None:
    """Wait until the heater is on."""
    while sensor.unit.power == 0:
        await sensor.unit.input.next()
    await sensor.good(2)


async def is_off(sensor: Sensor) -> None:
    """Wait until a calibration has the heater off for a while: at rest, or above its target."""
    await sensor.good(2)
    while sensor.unit.power > 0:
        await sensor.unit.input.next()


@pytest.mark.parametrize("phase", [is_on, is_off])
@pytest.mark.parametrize("calibration", CALIBRATIONS)
def test_the_machine_stops_when_the_sensor_falls_silent_during_a_calibration(
    tmp_path: Path, calibration: str, phase: Callable[[Sensor], Awaitable[None]]
) -> None:
    stage = HeatMachine(tmp_path, HOTEND_PID + "heater_power: 40\n", hurry=10)

    async def main() -> None:
        sensor = Sensor(stage)
        running = asyncio.ensure_future(stage.do(calibration.format("extruder", 60)))
        await phase(sensor)
        since_s = stage.now_s()
        sensor.silence()
        told = await stage.stopped(NOTICED_S)
        assert "heater extruder: its sensor has been silent for about 3 s; check node toolhead" in told
        with pytest.raises(CanductorError, match="has been silent"):
            await running
        edges = stage.edges("PB3")
        assert not edges or stage.heater_off_after(since_s) <= LIMIT_S

    stage.connected(main)


@pytest.mark.parametrize("calibration", CALIBRATIONS)
def test_a_calibration_ends_when_the_node_of_the_sensor_goes_away(tmp_path: Path, calibration: str) -> None:
    """The sensor's node may be absent, the heater's is another one: nothing stops, and nothing heats."""
    stage = HeatMachine(tmp_path, HOTEND_PID + BOX, hurry=20)

    async def main() -> None:
        sensor = Sensor(stage, "chamber")
        running = asyncio.ensure_future(stage.do(calibration.format("chamber", 60)))
        await is_on(sensor)
        since_s = stage.now_s()
        stage.stage.cut("box")
        with pytest.raises(CanductorError, match=r"heater chamber was turned off: node box is \w+"):
            await running
        assert stage.now_s() - since_s < LOST_S
        await asyncio.sleep(LIMIT_S)
        assert stage.heater_off_after(since_s, "PC3", "mcu") < LIMIT_S
        assert stage.machine.stopped is None

    stage.connected(main)


@pytest.mark.parametrize("line", ["M109 S200", "M104 S200"])
def test_the_heat_ends_before_the_node_of_the_heater_would_have_to_stop(tmp_path: Path, line: str) -> None:
    """At full power, that is; the machine stops a little later, as nobody knows how hot it is."""
    stage = HeatMachine(tmp_path, HOTEND_PID)

    async def main() -> None:
        sensor = Sensor(stage)
        heating = asyncio.ensure_future(stage.do(line))
        await is_on(sensor)
        since_s = stage.now_s()
        sensor.silence()
        told = await stage.stopped(NOTICED_S)
        assert "its sensor has been silent" in told
        assert 0.5 < stage.heater_off_after(since_s) < LIMIT_S - 0.1
        if line.startswith("M109"):
            with pytest.raises(CanductorError, match="has been silent"):
                await heating

    stage.connected(main)


def test_who_waits_for_a_target_learns_that_it_was_forgotten(tmp_path: Path) -> None:
    stage = HeatMachine(tmp_path, HOTEND_PID + BOX)

    async def main() -> None:
        line = "SET_HEATER_TEMPERATURE HEATER=chamber TARGET=60"
        await stage.do(line)
        sensor = Sensor(stage, "chamber")
        await is_on(sensor)
        waiting = asyncio.ensure_future(sensor.unit.reach())
        since_s = stage.now_s()
        stage.stage.cut("box")
        with pytest.raises(CanductorError, match=r"heater chamber was turned off: node box is \w+"):
            await waiting
        assert stage.now_s() - since_s < LOST_S
        assert stage.status("heater_generic chamber")["target"] == 0
        assert stage.machine.stopped is None
        assert stage.heater_off_after(since_s, "PC3", "mcu") < LIMIT_S

    stage.connected(main)


@pytest.mark.parametrize(
    ("line", "calibration"),
    list(
        zip(
            ["TURN_OFF_HEATERS", "SET_HEATER_TEMPERATURE HEATER=extruder TARGET=0"], CALIBRATIONS, strict=True
        )
    ),
)
def test_a_heater_that_is_switched_off_is_calibrated_no_more(
    tmp_path: Path, line: str, calibration: str
) -> None:
    """As by a user beside the program: off is off."""
    stage = HeatMachine(tmp_path, HOTEND_PID + "heater_power: 40\n", hurry=10)

    async def main() -> None:
        sensor = Sensor(stage)
        running = asyncio.ensure_future(stage.do(calibration.format("extruder", 200)))
        await is_on(sensor)
        off_s = stage.now_s()
        await stage.do(line)
        with pytest.raises(
            CanductorError, match=r"the calibration of \[extruder\] ended: it was switched off"
        ):
            await running
        assert stage.now_s() == off_s, "who waits for the calibration learns it at once"
        await asyncio.sleep(3.0)
        assert stage.heater_off_after(off_s) < 1.0
        assert stage.machine.stopped is None
        await stage.do("M104 S100")
        await is_on(sensor)

    stage.connected(main)
