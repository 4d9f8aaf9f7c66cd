"""The service in virtual time: jobs paused, resumed and cancelled at random moments lose no step."""

import asyncio
import random
from pathlib import Path

import pytest

from coordinator.simulate.scenario import load
from coordinator.simulate.stage import Stage
from tests.system.service_stage import Served, running, zigzag

CLEAN = Path("coordinator/simulate/scenarios/clean.toml")
MOVES = 150


@pytest.mark.parametrize("seed", range(8))
def test_pause_and_resume_at_random_moments(tmp_path: Path, seed: int) -> None:
    chance = random.Random(seed)
    world = Stage(load(CLEAN), seed)
    job = zigzag(MOVES, seed)
    stood = 0

    async def pause_once(stage: Served) -> int:
        await asyncio.sleep(chance.uniform(0.05, 3))
        if stage.job_state != "printing":
            return 0
        await stage.call("job.pause")
        if chance.random() < 0.3:  # taken back, often before it stands
            await asyncio.sleep(chance.uniform(0, 4))
        else:
            await stage.until_job("paused", "done")
        if stage.job_state == "done":
            return 0
        paused = stage.job_state == "paused"
        if paused:
            assert str(stage.service.state) == "paused"
            before = await stage.check_positions()
            await asyncio.sleep(chance.uniform(0, 2))
            assert await stage.check_positions() == before
        await stage.call("job.resume")
        return int(paused)

    async def go() -> int:
        stood = 0
        async with running(Served(tmp_path, lambda: world.description, world.host)) as stage:
            stage.write_job(job)
            await stage.call("job.start", file="job.gcode")
            while stage.job_state == "printing":
                stood += await pause_once(stage)
            await stage.until_job("done")
            await stage.check_positions()
            told = await stage.call("job.status")
            assert told["progress"] == 1.0
            assert told["print_time_s"] <= told["elapsed_s"]
            last = job.splitlines()[-1].split()
            x, y, *_ = stage.planned
            assert (f"X{x:.3f}", f"Y{y:.3f}") == (last[1], last[2])
        return stood

    with asyncio.Runner(loop_factory=world.make_loop) as runner:
        stood = runner.run(go())
    assert stood


@pytest.mark.parametrize("seed", range(4))
def test_cancel_at_random_moments(tmp_path: Path, seed: int) -> None:
    chance = random.Random(seed)
    world = Stage(load(CLEAN), seed)

    async def go() -> None:
        async with running(Served(tmp_path, lambda: world.description, world.host)) as stage:
            stage.write_job(zigzag(MOVES, seed))
            for _ in range(3):
                await stage.homing_comes()
                await stage.call("job.start", file="job.gcode")
                await asyncio.sleep(chance.uniform(0, 8))
                if chance.random() < 0.5:
                    await stage.call("job.pause")
                    await asyncio.sleep(chance.uniform(0, 6))
                await stage.call("job.cancel")
                await stage.until_job("cancelled")
                assert str(stage.service.state) == "ready"
                await stage.check_positions()

    with asyncio.Runner(loop_factory=world.make_loop) as runner:
        runner.run(go())
