"""A computer that takes a third of a second to make commands, in virtual time."""

import asyncio
from functools import partial
from itertools import pairwise
from pathlib import Path

import pytest

from coordinator.gcode.builtins import basic
from coordinator.gcode.commands import ProgramContext
from coordinator.gcode.parser import Command
from coordinator.simulate.scenario import load
from coordinator.simulate.stage import Stage
from nodes.virtual.world import VirtualLoop
from tests.stages.printer import Printer, gcode
from tests.stages.served import Served, running, zigzag

CLEAN = Path("coordinator/simulate/scenarios/clean.toml")
SLOW_S = 0.33
"""More than START_LEAD_S: without regard for it each first step after a standstill would be too late."""
REST_S = 3.0
LINE_S = 0.005
SLOW_LINES = 600
"""Together longer than commands are made ahead."""


def read_slowly(_job: ProgramContext, _command: Command) -> bool:
    """Read a line that does nothing, in LINE_S."""
    loop = asyncio.get_running_loop()
    assert isinstance(loop, VirtualLoop)
    loop.world.run_for(LINE_S)
    return True


def test_motion_begins_later_on_a_slow_computer(tmp_path: Path) -> None:
    """Failed before: "Stepper too far in past", at the first move or at the first one after a rest."""
    world = Stage(load(CLEAN), 5)

    async def go() -> None:
        async with running(Served(tmp_path, lambda: world.description, world.host)) as stage:
            stage.write_job(zigzag(20, 5))
            await stage.call("job.start", file="job.gcode")
            await stage.until_job("done")
            for line in range(5):
                await asyncio.sleep(REST_S)
                await stage.call("gcode.run", script=f"G1 X{10 + line} Y{20 - line} F3000")
            await asyncio.sleep(REST_S)
            await stage.check_positions()

    with asyncio.Runner(loop_factory=partial(world.make_loop, executor_s=SLOW_S)) as runner:
        runner.run(go())


def test_a_print_stands_still_while_lines_take_long_to_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Failed before: all of them were read before the next steps were made, which came too late."""
    world = Stage(load(CLEAN), 3)
    monkeypatch.setitem(basic.HANDLERS, "G21", read_slowly)

    async def go() -> None:
        async with running(Served(tmp_path, lambda: world.description, world.host)) as stage:
            stage.write_job(zigzag(20, 5) + "G21\n" * SLOW_LINES + "G1 X30 Y30\nG1 X60 Y50\n")
            await stage.call("job.start", file="job.gcode")
            await stage.until_job("done")
            await stage.check_positions()

    with asyncio.Runner(loop_factory=world.make_loop) as runner:
        runner.run(go())


def test_a_clients_lines_that_take_long_let_others_have_their_turn(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """While a job waits for a heater. Failed before: they were all read in one go."""
    monkeypatch.setitem(basic.HANDLERS, "M220", read_slowly)
    printer = Printer(tmp_path)
    turns_s: list[float] = []

    async def note_turns() -> None:
        while True:
            turns_s.append(asyncio.get_running_loop().time())
            await asyncio.sleep(0.05)

    async def go(stage: Served) -> None:
        stage.write_job("M109 S250\n")
        await stage.call("job.start", file="job.gcode")
        await stage.until(lambda: printer.status("extruder")["target"] == 250, "the heater's target")
        await asyncio.sleep(1.0)
        noting = asyncio.ensure_future(note_turns())
        await asyncio.sleep(0)
        lines = asyncio.ensure_future(gcode(stage, *["M220 S100"] * 300))
        await lines
        noting.cancel()
        assert stage.job_state == "printing"

    printer.serve(go)
    assert max(after - before for before, after in pairwise(turns_s)) < 100 * LINE_S
    assert turns_s[-1] - turns_s[0] < 400 * LINE_S, "no cycle pauses while there are more"


def test_who_asks_for_a_restart_is_answered_on_a_busy_computer(tmp_path: Path) -> None:
    """Failed before: "the machine stopped: it restarts", where the last pause took a little longer."""
    world = Stage(load(CLEAN), 1)

    async def other_programs() -> None:
        while True:
            await asyncio.sleep(0.031)
            world.stall(0.03, io=False)

    async def go() -> None:
        async with running(Served(tmp_path, lambda: world.description, world.host)) as stage:
            await asyncio.sleep(1.0)
            busy = asyncio.ensure_future(other_programs())
            await stage.call("gcode.run", script="RESTART")
            busy.cancel()
            await stage.until(lambda: stage.service.starts == 2, "the next start")
            await stage.until_state("ready")

    with asyncio.Runner(loop_factory=world.make_loop) as runner:
        runner.run(go())
