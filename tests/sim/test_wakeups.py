"""How often the coordinator wakes up, in virtual time: at rest, for a line of a client, while printing."""

import asyncio
from pathlib import Path

from coordinator.modules.heaters.sections import HeaterBed
from coordinator.simulate.scenario import load
from coordinator.simulate.stage import Stage
from coordinator.streaming.streamer import FULL_CYCLE_S, FULL_EARLY_S, REST_CYCLE_S
from coordinator.streaming.worker import MAKE_AHEAD_S
from nodes.devices.analog_in import REPORT_S
from nodes.node.node import PATIENCE_S, REST_PATIENCE_S
from tests.stages.printer import PRINTING, Printer, gcode
from tests.stages.served import Served, running, zigzag

CLEAN = Path("coordinator/simulate/scenarios/clean.toml")
REST_S = 10.0
SCRIPT_S = 0.005
"""In virtual time, which does not pass while anything is computed: a wait for the next cycle would show."""
SOON_S = 0.03
"""A measurement takes some 10 ms, and its way."""
SECOND_SENSOR = """
[temperature_sensor frame]
sensor_type: Generic 3950
sensor_pin: PB7
"""
QUESTIONS = 8
"""Other things wake the coordinator, too: not each of them waits as long as it may."""
SETTLE_S = 1.5
"""Until the tree is not read any more."""


def test_nothing_is_polled(tmp_path: Path) -> None:
    world = Stage(load(CLEAN), 5)

    async def rest(stage: Served) -> None:
        motion = stage.service.motion
        assert motion is not None
        cycles, sequence = motion.streamer.cycles, stage.tree.sequence
        await asyncio.sleep(REST_S)
        assert motion.streamer.cycles - cycles <= REST_S / REST_CYCLE_S + 1
        assert stage.tree.sequence == sequence, "nobody reads the tree, so nobody fills it"
        print_time_s = stage.tree.get("position.print_time_s")
        assert isinstance(print_time_s, float)
        assert abs(print_time_s - motion.now_s) < 0.001, "it is filled when somebody reads it"

    async def ask(stage: Served) -> None:
        loop = asyncio.get_running_loop()
        for pause_s in (0.0, 0.313, 0.777, 1.234):
            await asyncio.sleep(pause_s)
            begun_s = loop.time()
            await stage.call("gcode.run", script="M220 S100")
            assert loop.time() - begun_s <= SCRIPT_S

    async def print_file(stage: Served) -> None:
        motion = stage.service.motion
        assert motion is not None
        stage.write_job(zigzag(150, 5))
        await stage.call("job.start", file="job.gcode")
        await asyncio.sleep(6.0)
        lead_s, cycles = motion.lead.now_s, motion.streamer.cycles
        assert lead_s is not None
        assert lead_s >= MAKE_AHEAD_S - FULL_CYCLE_S - 0.01
        await asyncio.sleep(3.0)
        assert motion.streamer.cycles - cycles <= 3.0 / (FULL_CYCLE_S - FULL_EARLY_S) + 2
        await stage.until_job("done")
        await stage.check_positions()

    async def go() -> None:
        async with running(Served(tmp_path, lambda: world.description, world.host)) as stage:
            await asyncio.sleep(SETTLE_S)
            await rest(stage)
            await ask(stage)
            await print_file(stage)
            await asyncio.sleep(2 * SETTLE_S)
            await rest(stage)

    with asyncio.Runner(loop_factory=world.make_loop) as runner:
        runner.run(go())


def test_measurements_wait_only_while_nothing_acts_on_them(tmp_path: Path) -> None:
    printer = Printer(tmp_path)

    async def go(stage: Served) -> None:
        machine, motion = stage.service.machine, stage.service.motion
        assert machine is not None
        assert motion is not None
        bed = machine.modules.find("heater_bed", HeaterBed)
        assert bed is not None
        ages_s: list[float] = []
        act = bed.unit.input.on_measured

        def measured(at_s: float, celsius: float) -> None:
            ages_s.append(motion.now_s - at_s)
            act(at_s, celsius)

        bed.unit.input.on_measured = measured

        async def oldest_s() -> float:
            await asyncio.sleep(REST_CYCLE_S + REST_PATIENCE_S)  # until it is known whether it is on
            ages_s.clear()
            await asyncio.sleep(5.0)
            assert len(ages_s) > 5.0 / REPORT_S - 5, "none is lost"
            return max(ages_s)

        for _ in range(2):
            assert REST_PATIENCE_S / 2 < await oldest_s() < REST_PATIENCE_S + SOON_S
            await gcode(stage, "M140 S60")
            assert await oldest_s() < SOON_S
            await gcode(stage, "M140 S0")

    printer.serve(go)


def test_the_sensors_of_a_node_wake_the_coordinator_together(tmp_path: Path) -> None:
    printer = Printer(tmp_path, PRINTING + SECOND_SENSOR)

    async def go(stage: Served) -> None:
        machine, loop = stage.service.machine, asyncio.get_running_loop()
        assert machine is not None
        await gcode(stage, "M140 S60")
        await asyncio.sleep(REST_CYCLE_S + REST_PATIENCE_S)
        times_s: list[float] = []
        end = machine.primary.on("analog_in_state", None, lambda _: times_s.append(loop.time()))
        await asyncio.sleep(5.0)
        end()
        assert len(times_s) >= 2 * (5.0 / REPORT_S - 1)
        assert len(set(times_s)) <= len(times_s) / 2 + 1

    printer.serve(go)


def test_the_state_of_a_node_waits_only_while_nothing_can_happen(tmp_path: Path) -> None:
    printer = Printer(tmp_path)

    async def go(stage: Served) -> None:
        machine, loop = stage.service.machine, asyncio.get_running_loop()
        assert machine is not None

        async def longest_s() -> float:
            await asyncio.sleep(REST_CYCLE_S + REST_PATIENCE_S)
            took_s = []
            for _ in range(QUESTIONS):
                asked_s = loop.time()
                await machine.primary.query("get_config", "config", patient=True)
                took_s.append(loop.time() - asked_s)
                await asyncio.sleep(0.1)
            return max(took_s)

        at_once_s = PATIENCE_S["config"] + SOON_S
        assert at_once_s < await longest_s() < REST_PATIENCE_S + SOON_S
        await gcode(stage, "M140 S60")
        assert await longest_s() < at_once_s
        await gcode(stage, "M140 S0")
        assert await longest_s() > at_once_s
        moving = asyncio.ensure_future(gcode(stage, "G28", *["G1 X200 F3000", "G1 X10"] * 10))
        assert await longest_s() < at_once_s
        assert not moving.done()
        await moving

    printer.serve(go)
