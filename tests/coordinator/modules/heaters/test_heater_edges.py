"""A heater's own net, to the measurement: what it counts, when exactly it gives up, what stays off."""

import asyncio
from pathlib import Path
from typing import Any

import pytest

from coordinator.heat.mpc import Mpc
from coordinator.modules.heaters.heater import LOOK_S, STALE_SPARE_S
from coordinator.modules.outputs.timing import AHEAD_S
from nodes.support.errors import CanductorError
from tests.coordinator.modules.heaters.broken_sensor import Sensor
from tests.stages.heat_machine import HOTEND_PID, HeatMachine

BAD_ALLOWED = 6
"""So many bad measurements in a row the host lets pass: two more than the node, which stops by itself."""
BROKEN_C = 500.0
LIMIT_S = 1.5
"""max_duration, as it is without the option."""
SLACK_S = 0.15
"""Of looking, sampling and wires."""
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
"""


async def heating(stage: HeatMachine) -> Sensor:
    """Return the sensor of the extruder, which is on."""
    await stage.do("M104 S250")
    sensor = Sensor(stage)
    await sensor.good(5)
    assert sensor.unit.power > 0
    return sensor


def measure(sensor: Sensor, celsius: float, times: int = 1) -> None:
    """Give the heater measurements that its node did not find out of range: its net has failed."""
    for _ in range(times):
        sensor.unit.input.on_measured(0.0, celsius)
        assert sensor.unit.power == 0


@pytest.mark.parametrize("celsius", [BROKEN_C, -40.0])
def test_the_host_stops_the_machine_when_the_nodes_net_fails(tmp_path: Path, celsius: float) -> None:
    stage = HeatMachine(tmp_path, HOTEND_PID)

    async def main() -> None:
        sensor = await heating(stage)
        for _ in range(3):  # a sound measurement between them, and they count from the beginning
            measure(sensor, celsius, BAD_ALLOWED)
            await sensor.good(1)
            assert stage.machine.stopped is None
        measure(sensor, celsius, BAD_ALLOWED)
        assert stage.machine.stopped is None
        measure(sensor, celsius)
        assert stage.machine.stopped is not None
        assert (
            f"heater extruder: its sensor reads {celsius:.0f} °C, outside 0 to 300 °C;"
            " check the sensor and its wires"
        ) in await stage.stopped(1.0)

    stage.connected(main)


@pytest.mark.parametrize("celsius", [0.0, 300.0])
def test_the_limits_themselves_are_no_bad_measurements(tmp_path: Path, celsius: float) -> None:
    stage = HeatMachine(tmp_path, HOTEND_PID)

    async def main() -> None:
        sensor = await heating(stage)
        for _ in range(BAD_ALLOWED + 2):
            sensor.unit.input.on_measured(0.0, celsius)
        assert stage.machine.stopped is None
        assert (sensor.unit.power > 0) == (celsius == 0), "it is controlled as ever"

    stage.connected(main)


def test_power_that_nothing_renews_ends_before_the_node_would_stop(tmp_path: Path) -> None:
    """Within max_duration less what a value is sent ahead and two looks; not sooner."""
    stage = HeatMachine(tmp_path, HOTEND_PID)

    async def main() -> None:
        sensor = await heating(stage)
        await sensor.unit.input.next()
        since_s = stage.now_s()
        sensor.silence()
        await asyncio.sleep(LIMIT_S - AHEAD_S - STALE_SPARE_S - SLACK_S)
        assert sensor.unit.power > 0
        await asyncio.sleep(2 * SLACK_S)
        assert sensor.unit.power == 0
        await asyncio.sleep(AHEAD_S)
        off_s = stage.heater_off_after(since_s)
        assert LIMIT_S - STALE_SPARE_S - SLACK_S < off_s < LIMIT_S
        assert stage.machine.stopped is None, "that is for the looks at the sensor to decide"

    stage.connected(main)


def test_a_silent_sensor_stops_the_machine_at_the_third_look(tmp_path: Path) -> None:
    stage = HeatMachine(tmp_path, HOTEND_PID)

    async def main() -> None:
        sensor = await heating(stage)
        await sensor.unit.input.next()
        since_s = stage.now_s()
        sensor.silence()
        assert "its sensor has been silent for about 3 s; check node toolhead" in await stage.stopped()
        assert 3 * LOOK_S - SLACK_S < stage.now_s() - since_s < 4 * LOOK_S + SLACK_S

    stage.connected(main)


def test_a_heater_whose_measurements_cannot_be_handled_is_switched_off_and_stops_the_machine(
    tmp_path: Path,
) -> None:
    """Failed before: its sensor seemed well, and without heat all went on until it was too cold."""
    stage = HeatMachine(tmp_path, HOTEND_PID)
    bugs: list[dict[str, Any]] = []

    class Broken:
        def power(self, *_: float) -> float:
            raise ZeroDivisionError

        def settled(self, *_: float) -> bool:
            raise ZeroDivisionError

    async def main() -> None:
        asyncio.get_running_loop().set_exception_handler(lambda _, context: bugs.append(context))
        sensor = await heating(stage)
        await sensor.unit.input.next()
        since_s = stage.now_s()
        sensor.unit.use(Broken())
        assert (
            "heater extruder: no measurement could be handled for about 3 s; this is a bug, please report it"
        ) in await stage.stopped()
        assert stage.now_s() - since_s < 4 * LOOK_S + SLACK_S
        assert stage.heater_off_after(since_s) < LIMIT_S - 0.1

    stage.connected(main)
    assert [bug["message"].partition(" could")[0] for bug in bugs] == ["node toolhead: analog_in_state"]


def test_a_heater_whose_sensors_node_goes_away_forgets_all(tmp_path: Path) -> None:
    """Its own node stays: that is switched off, at once and not by its max_duration, and it stays off."""
    stage = HeatMachine(tmp_path, HOTEND_PID + BOX)

    async def main() -> None:
        await stage.do("SET_HEATER_TEMPERATURE HEATER=chamber TARGET=60")
        sensor = Sensor(stage, "chamber")
        await sensor.good(4)
        unit = sensor.unit
        assert unit.power > 0
        await asyncio.sleep(0.2)  # half of what the last value was sent ahead
        unit._switch_off("node box is lost")
        since_s = stage.now_s()
        assert (unit.target_c, unit.power, unit._on) == (0.0, 0.0, False)
        with pytest.raises(CanductorError, match="heater chamber was turned off: node box is lost"):
            await unit._next()
        await asyncio.sleep(AHEAD_S + 0.05)
        off_s = stage.heater_off_after(since_s, "PC3", "mcu")
        assert abs(off_s - AHEAD_S) < 0.05
        told = "heater chamber was turned off; its target (60 °C) was cleared: node box is lost"
        assert [notice for notice in stage.notices if "was cleared" in notice] == [told]
        await sensor.good(4)
        assert unit.power == 0
        edges = len(stage.edges("PC3", "mcu"))
        unit._switch_off("again")  # no target, no power: there is nothing to say and nothing to switch
        await asyncio.sleep(1.0)
        assert len(stage.edges("PC3", "mcu")) == edges
        assert [notice for notice in stage.notices if "was cleared" in notice] == [told]
        await stage.do("SET_HEATER_TEMPERATURE HEATER=chamber TARGET=0.5")
        assert unit._off_because is None
        unit._switch_off("a target below one degree is one, too")
        assert len([notice for notice in stage.notices if "was cleared" in notice]) == 2
        assert stage.machine.stopped is None

    stage.connected(main)


def test_a_heater_that_is_off_is_not_looked_after(tmp_path: Path) -> None:
    """Neither a silent sensor nor a node that went away matters then."""
    stage = HeatMachine(tmp_path, HOTEND_PID + BOX)

    async def main() -> None:
        sensor = Sensor(stage, "chamber")
        await sensor.good(1)
        Sensor(stage).silence()
        stage.stage.cut("box")
        await asyncio.sleep(8.0)
        assert stage.machine.stopped is None
        assert sensor.unit._off_because is None

    stage.connected(main)


@pytest.mark.parametrize("celsius", [20.0, BROKEN_C])
def test_a_measurement_after_the_end_changes_nothing(tmp_path: Path, celsius: float) -> None:
    stage = HeatMachine(tmp_path, HOTEND_PID)

    async def main() -> None:
        sensor = await heating(stage)
        sensor.unit.input.on_measured(1e6, 20.0)  # so late that the heater should be much hotter by now
        assert "did not get 2 K nearer to 250 °C" in await stage.stopped(1.0)
        await asyncio.sleep(1.0)
        assert sensor.unit.power == 0
        said = len(stage.notices)
        for _ in range(BAD_ALLOWED + 2):
            sensor.unit.input.on_measured(1e6, celsius)
        assert sensor.unit._bad == 0, "what comes then is not even looked at"
        assert sensor.unit.power == 0
        assert len(stage.notices) == said

    stage.connected(main)


class Trial:
    """A calibration at full power that never ends by itself, and fails at measurement FAILS_AT."""

    watched_c = 60.0

    def __init__(self, fails_at: int) -> None:
        self.measurements = 0
        self._fails_at = fails_at

    def power(self, now_s: float, measured_c: float, target_c: float = 0.0) -> float:
        del now_s, measured_c, target_c
        self.measurements += 1
        if self.measurements >= self._fails_at:
            raise CanductorError("the calibration did not find anything")
        return 1.0

    @property
    def is_done(self) -> bool:
        return False


def test_a_calibration_that_fails_heats_no_more_from_that_measurement_on(tmp_path: Path) -> None:
    stage = HeatMachine(tmp_path, HOTEND_PID)

    async def main() -> None:
        await stage.do("M104 S250")  # not for the calibration, and no more after it
        sensor, trial = Sensor(stage), Trial(fails_at=4)
        running = asyncio.ensure_future(sensor.unit.tune(trial))
        await sensor.good(3)
        assert sensor.unit.power == 1.0
        measure(sensor, 25.0, 3)  # the first fails it; the others come before who calibrates has noticed
        assert trial.measurements == 4, "it is not asked again"
        with pytest.raises(CanductorError, match="the calibration did not find anything"):
            await running
        await sensor.good(3)
        assert sensor.unit.power == 0
        assert trial.measurements == 4

    stage.connected(main)


def test_a_calibration_whose_node_went_away_heats_no_more(tmp_path: Path) -> None:
    stage = HeatMachine(tmp_path, HOTEND_PID)

    async def main() -> None:
        sensor, trial = Sensor(stage), Trial(fails_at=1000)
        running = asyncio.ensure_future(sensor.unit.tune(trial))
        await sensor.good(3)
        sensor.unit._switch_off("node box is lost")
        asked = trial.measurements
        measure(sensor, 25.0, 3)
        assert trial.measurements == asked
        with pytest.raises(CanductorError, match="heater extruder was turned off: node box is lost"):
            await running

    stage.connected(main)


def test_a_heater_that_was_never_calibrated_does_not_heat(tmp_path: Path) -> None:
    stage = HeatMachine(tmp_path, "control: mpc\nheater_power: 40\n")

    async def main() -> None:
        sensor = Sensor(stage)
        await sensor.good(5)
        assert sensor.unit.controller is None
        assert sensor.unit.power == 0
        assert not any(level for _, level in stage.edges("PB3"))

    stage.connected(main)


def test_a_model_uses_the_sensor_around_its_heater_once_that_has_measured(tmp_path: Path) -> None:
    path = tmp_path / "room"
    path.write_text("31500")
    model = (
        "control: mpc\nheater_power: 40\nblock_heat_capacity: 13\nambient_transfer: 0.075\n"
        "sensor_responsiveness: 0.5\nambient_temp_sensor: temperature_sensor room\n"
        "\n[temperature_sensor room]\nsensor_type: temperature_host\nmin_temp: 0\nmax_temp: 90\n"
        f"sensor_path: {path}\n"
    )
    stage = HeatMachine(tmp_path, model)

    async def main() -> None:
        sensor = await heating(stage)
        await sensor.good(10)
        controller = sensor.unit.controller
        assert isinstance(controller, Mpc)
        assert controller._ambient_c == 31.5
        path.write_text("28500")
        await sensor.good(10)
        assert controller._ambient_c == 28.5

    stage.connected(main)


def test_nobody_is_asked_for_power_after_a_fault(tmp_path: Path) -> None:
    stage = HeatMachine(tmp_path, HOTEND_PID)

    async def main() -> None:
        sensor, trial = Sensor(stage), Trial(fails_at=1000)
        running = asyncio.ensure_future(sensor.unit.tune(trial))
        await sensor.good(3)
        asked = trial.measurements
        sensor.unit.input.on_measured(1e6, 20.0)
        assert trial.measurements == asked
        with pytest.raises(CanductorError, match="did not get 2 K nearer to 60 °C"):
            await running

    stage.connected(main)
