"""A computer that takes a third of a second to make commands, in virtual time."""

import asyncio
from functools import partial
from pathlib import Path

from coordinator.simulate.scenario import load
from coordinator.simulate.stage import Stage
from tests.stages.served import Served, running, zigzag

CLEAN = Path("coordinator/simulate/scenarios/clean.toml")
SLOW_S = 0.33
"""More than START_LEAD_S: without regard for it each first step after a standstill would be too late."""
REST_S = 3.0


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
