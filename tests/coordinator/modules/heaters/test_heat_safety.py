"""What ends with the heaters off, on the node itself, as the log of its pins shows."""

import asyncio
import re
from pathlib import Path

import pytest

from nodes.node.states import NodeState
from nodes.virtual.plant_page import PlantFault, PlantItemKind
from tests.stages.heat_machine import BED, HeatMachine

PID = "control: pid\npid_kp: 10\npid_ki: 1\npid_kd: 15\n"
LIMIT_S = 1.5
"""max_duration, as it is without the option."""
NOTICE_S = 2.0
"""Within this the host has given up on a node that is silent."""


def heating(tmp_path: Path, text: str = "", **options: float) -> HeatMachine:
    return HeatMachine(tmp_path, PID + text, **options)  # type: ignore[arg-type]


async def hold(stage: HeatMachine, celsius: float = 150) -> None:
    await stage.do(f"M104 S{celsius}")
    await stage.do(f"TEMPERATURE_WAIT SENSOR=extruder MINIMUM={celsius - 3}")
    await asyncio.sleep(2)
    assert stage.machine.stopped is None


@pytest.mark.parametrize("fault", [PlantFault.OPEN, PlantFault.SHORTED])
@pytest.mark.parametrize("hot", [True, False])
def test_a_sensor_whose_wire_is_broken(tmp_path: Path, fault: PlantFault, hot: bool) -> None:
    stage = heating(tmp_path, hurry=5)

    async def main() -> None:
        if hot:
            await hold(stage)
        else:
            await stage.do("M104 S200")
            await asyncio.sleep(2)
        broken_s = stage.now_s()
        stage.fault(PlantItemKind.SENSOR, fault)
        text = await stage.stopped()
        celsius = "-?\\d+ °C, allowed are 0 to 300 °C; is a wire broken or shorted\\?"
        assert re.search(rf"node toolhead shut down: ADC out of range \(extruder: {celsius}\)", text), text
        await asyncio.sleep(1)
        # Four measurements, 0.3 s apart; no host is needed.
        assert 0 < stage.heater_off_after(broken_s) < 1.8
        assert stage.status("extruder")["target"] == 0

    stage.connected(main)


def test_a_sensor_that_fell_out(tmp_path: Path) -> None:
    stage = heating(tmp_path)

    async def main() -> None:
        await hold(stage)
        stage.fault(PlantItemKind.SENSOR, PlantFault.FALLEN)
        text = await stage.stopped()
        assert "heater extruder does not hold 150 °C" in text
        told_s = stage.now_s()
        await asyncio.sleep(1)
        assert stage.heater_off_after(told_s) < 0.1
        assert stage.true_c() < 230, "before anything burns"

    stage.connected(main)


def test_a_heater_that_does_nothing(tmp_path: Path) -> None:
    stage = heating(tmp_path)

    async def main() -> None:
        stage.fault(PlantItemKind.HEATER, PlantFault.DEAD)
        await stage.do("M104 S200")
        text = await stage.stopped()
        assert "heater extruder is at 25" in text
        assert "did not get 2 K nearer" in text
        told_s = stage.now_s()
        await asyncio.sleep(1)
        assert stage.heater_off_after(told_s) < 0.1

    stage.connected(main)


def test_a_switch_that_is_stuck_on_while_it_is_off(tmp_path: Path) -> None:
    stage = heating(tmp_path)

    async def main() -> None:
        await asyncio.sleep(35)
        stage.fault(PlantItemKind.HEATER, PlantFault.STUCK_ON)
        text = await stage.stopped()
        assert "heats though it is off" in text
        assert stage.true_c() < 100, "long before the node would stop at max_temp"

    stage.connected(main)


def test_a_switch_that_is_stuck_on_while_it_holds_ends_at_the_nodes_own_limit(tmp_path: Path) -> None:
    stage = heating(tmp_path, hurry=3)

    async def main() -> None:
        await hold(stage, 200)
        stage.fault(PlantItemKind.HEATER, PlantFault.STUCK_ON)
        text = await stage.stopped()
        assert "heats though it is off" in text or "ADC out of range" in text
        assert stage.true_c() < 320
        await asyncio.sleep(1)
        assert stage.heater_off_after(stage.now_s()) < 0, "the pin says off; the switch does not obey"

    stage.connected(main)


def test_more_cooling_than_the_heater_can_give(tmp_path: Path) -> None:
    stage = heating(tmp_path, "max_power: 0.4\n", hurry=5)

    async def main() -> None:
        await stage.do("M104 S290")
        text = await stage.stopped()
        assert "did not get 2 K nearer to 290 °C" in text

    stage.connected(main)


def test_the_wires_to_a_node_are_cut(tmp_path: Path) -> None:
    """The node on the wires counts by itself; the other one is stopped by the host, who has to notice."""
    stage = heating(tmp_path, BED, hurry=5)

    async def main() -> None:
        await stage.do("M140 S100")
        await hold(stage, 200)
        board = stage.node("toolhead")
        assert board.controller is not None
        board.controller.cut(1)
        cut_s = stage.now_s()
        text = await stage.stopped()
        assert "toolhead" in text
        await asyncio.sleep(LIMIT_S + 2)
        assert stage.heater_off_after(cut_s) <= LIMIT_S
        assert stage.heater_off_after(cut_s, "PC1", "mcu") <= NOTICE_S

    stage.connected(main)


@pytest.mark.parametrize("frozen", ["python", "all"])
def test_the_host_stands_still_for_two_seconds(tmp_path: Path, frozen: str) -> None:
    stage = heating(tmp_path, hurry=5)

    async def main() -> None:
        await hold(stage, 200)
        stalled_s = stage.now_s()
        stage.stage.stall(2.0, io=frozen == "all")
        text = await stage.stopped()
        assert "node toolhead shut down" in text
        await asyncio.sleep(1)
        off_s = stage.heater_off_after(stalled_s)
        assert 0 < off_s <= LIMIT_S

    stage.connected(main)


def test_a_host_that_is_slow_does_not_end_the_heat(tmp_path: Path) -> None:
    stage = heating(tmp_path, hurry=5)

    async def main() -> None:
        await hold(stage, 200)
        for _ in range(5):
            stage.stage.stall(0.7)
            await asyncio.sleep(3)
        assert stage.machine.stopped is None
        low, high = await stage.true_range(5)
        assert 190 < low <= high < 210

    stage.connected(main)


def test_the_host_is_gone(tmp_path: Path) -> None:
    """The machine is closed in the midst of heating: nobody renews anything."""
    stage = heating(tmp_path, hurry=5)

    async def main() -> None:
        await hold(stage, 200)

    stage.connected(main)
    gone_s = stage.now_s()
    stage.run(lambda: asyncio.sleep(10))
    assert 0 < stage.heater_off_after(gone_s) <= LIMIT_S


def test_an_emergency_stop(tmp_path: Path) -> None:
    stage = heating(tmp_path, BED, hurry=5)

    async def main() -> None:
        await stage.do("M140 S100")
        await hold(stage, 200)
        stopped_s = stage.now_s()
        stage.machine.stop("M112")
        await asyncio.sleep(1)
        assert stage.heater_off_after(stopped_s) < 0.05
        assert stage.heater_off_after(stopped_s, "PC1", "mcu") < 0.05
        assert stage.status("heater_bed")["target"] == 0

    stage.connected(main)


def test_who_waits_for_a_temperature_learns_that_it_will_not_come(tmp_path: Path) -> None:
    stage = heating(tmp_path)

    async def main() -> None:
        stage.fault(PlantItemKind.HEATER, PlantFault.DEAD)
        waiting = asyncio.ensure_future(stage.do("M109 S200"))
        await stage.stopped()
        await asyncio.wait((waiting,), timeout=10)
        assert "did not get 2 K nearer" in str(waiting.exception())

    stage.connected(main)


BOX = (
    "\n[mcu box]\ncanbus_uuid: 0123456789ad\ncanbus_interface: can0\npolicy: optional\n"
    "\n[heater_generic chamber]\nheater_pin: box:PA1\nsensor_type: Generic 3950\nsensor_pin: box:PA2\n"
    "min_temp: 0\nmax_temp: 100\ncontrol: watermark\n"
)


def test_a_node_that_may_be_away_takes_its_heater_along(tmp_path: Path) -> None:
    stage = heating(tmp_path, BOX, hurry=3)

    async def main() -> None:
        await stage.do("SET_HEATER_TEMPERATURE HEATER=chamber TARGET=60")
        await asyncio.sleep(3)
        board = stage.node("box")
        assert board.controller is not None
        cut_s = stage.now_s()
        board.controller.cut(1)
        await asyncio.sleep(8)
        assert stage.machine.stopped is None
        assert stage.status("heater_generic chamber")["target"] == 0
        assert any(
            "heater chamber was turned off; its target (60 °C) was cleared" in n for n in stage.notices
        )
        assert 0 < stage.heater_off_after(cut_s, "PA1", "box") <= LIMIT_S
        board.controller.cut(0)
        async with asyncio.timeout(60):
            while stage.machine.nodes["box"].state is not NodeState.READY:  # noqa: ASYNC110  virtual time
                await asyncio.sleep(0.1)
        assert stage.edges("PA1", "box")[-1][1] == 0
        await stage.do("SET_HEATER_TEMPERATURE HEATER=chamber TARGET=60")
        await asyncio.sleep(3)
        assert stage.edges("PA1", "box")[-1][1] == 1

    stage.connected(main)
