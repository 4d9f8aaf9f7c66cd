"""The service in virtual time: jobs paused, resumed and cancelled at random moments lose no step."""

import asyncio
import random
from pathlib import Path

import pytest

from coordinator.ipc.protocol.methods import ApiError
from coordinator.simulate.scenario import load
from coordinator.simulate.stage import Stage
from coordinator.streaming.streamer import FULL_CYCLE_S
from tests.profiles import examples
from tests.stages.demo_machine import DemoMachine
from tests.stages.served import LOOK_S, Served, running, zigzag

CLEAN = Path("coordinator/simulate/scenarios/clean.toml")
MOVES = 150


@pytest.mark.parametrize("seed", range(examples(4)))
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


@pytest.mark.parametrize("seed", range(examples(2)))
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


def test_restart_when_idle_begins_anew(tmp_path: Path) -> None:
    world = Stage(load(CLEAN), 1)

    async def go() -> None:
        async with running(Served(tmp_path, lambda: world.description, world.host)) as stage:
            await stage.call("gcode.run", script="G28\nG1 X20 F6000")
            busy = asyncio.ensure_future(stage.call("move.by", x=100, speed_mm_s=50))
            motion = stage.service.motion
            assert motion is not None
            await stage.until(lambda: not motion.standing, "motion")
            with pytest.raises(ApiError, match="moves"):
                await stage.call("machine.restart")
            await busy
            await stage.call("machine.restart")
            await stage.until(lambda: stage.service.starts == 2, "a second start")
            assert stage.tree.get("position.homed") == ""
            await stage.until_state("ready")
            with pytest.raises(ApiError, match="before it is homed"):
                await stage.call("move.by", x=1)
            await stage.call("gcode.run", script="G28\nG1 X20 F6000")
            # The nodes' counts go on from the first life, what is sent counts anew.
            told = await stage.call("position.get")
            assert told["steppers"]["stepper_x"]["steps_sent"] > 0

    with asyncio.Runner(loop_factory=world.make_loop) as runner:
        runner.run(go())


@pytest.mark.parametrize("after_s", [0.0, 0.05, 0.5, 1.5])
def test_emergency_stop_while_it_starts(tmp_path: Path, after_s: float) -> None:
    world = Stage(load(CLEAN), 1)

    async def go() -> None:
        stage = Served(tmp_path, lambda: world.description, world.host)
        life = asyncio.ensure_future(stage.service.run())
        try:
            await asyncio.sleep(after_s)
            assert str(stage.service.state) == "startup"
            await stage.call("machine.emergency_stop", who="me")
            await stage.until_state("shutdown")
            assert stage.service.cause == "emergency stop by 'me'"
            await stage.call("machine.restart")
            await stage.until_state("ready")
            assert stage.service.starts == 2
        finally:
            life.cancel()
            await asyncio.gather(life, return_exceptions=True)

    with asyncio.Runner(loop_factory=world.make_loop) as runner:
        runner.run(go())


def test_a_stop_in_the_middle_of_a_job_shows_no_more_motion(tmp_path: Path) -> None:
    world = Stage(load(CLEAN), 2)

    async def go() -> None:
        async with running(Served(tmp_path, lambda: world.description, world.host)) as stage:
            stage.write_job(zigzag(MOVES, 2))
            await stage.call("job.start", file="job.gcode")
            await stage.until(lambda: bool(stage.tree.get("position.moving")), "motion")
            await stage.call("machine.emergency_stop")
            at = stage.tree.get("position.commanded")
            assert stage.tree.get("position.moving") is False
            await asyncio.sleep(2)
            assert stage.tree.get("position.commanded") == at
            assert stage.tree.get("job.state") == "stopped"

    with asyncio.Runner(loop_factory=world.make_loop) as runner:
        runner.run(go())


def test_progress_is_at_the_line_that_waits(tmp_path: Path) -> None:
    """While a heater is waited for, or a macro pauses, the place in the file is that of the very line."""
    world = DemoMachine(tmp_path, sections="[gcode_macro REST]\ngcode:\n  G4 P1000\n  G4 P3000\n")
    lines = ["; a print", "G28", "G4 P4000", "G1 X20 F1200", "G1 X25", "REST", "G1 X30", "G4 P4000"]
    text = "".join(f"{line}\n" for line in lines)

    async def go(stage: Served) -> None:
        stage.write_job(text)
        await stage.call("job.start", file="job.gcode")
        seen: dict[int, float] = {}
        while stage.job_state != "done":
            done = stage.tree.get("job.done_bytes")
            assert isinstance(done, int)
            seen[done] = seen.get(done, 0) + LOOK_S
            await asyncio.sleep(LOOK_S)
        begins = {line: text.index(f"{line}\n") for line in lines}
        last = text.rindex("G4 P4000")
        assert set(seen) <= {*begins.values(), last, len(text)}
        shown_s = 4.0 - FULL_CYCLE_S - 2 * LOOK_S  # each cycle brings the place up to date
        for waiting in (begins["G4 P4000"], begins["REST"], last):
            assert seen[waiting] > shown_s, seen

    world.serve(go)


def test_what_a_page_shows_of_jobs(tmp_path: Path) -> None:
    """What a program waits for, the picture, the macros; and the history, also in the next service."""
    macro = "[gcode_macro WAVE]\ndescription: Wave the head\ngcode: G4 P1\n"
    world = DemoMachine(tmp_path, sections=macro)
    picture = "; thumbnail begin 8x8 12\n; iVBORw0KGgo=\n; thumbnail end\n"

    async def waits(stage: Served, line: str, low: float | None, high: float | None) -> None:
        assert world_waits(stage) is None
        stage.write_job(f"{line}\n")
        await stage.call("job.start", file="job.gcode")
        await stage.until(lambda: world_waits(stage) is not None, line)
        assert world_waits(stage) == {"name": "heater_bed", "minimum": low, "maximum": high}
        await stage.call("machine.emergency_stop")
        await stage.call("machine.restart")
        await stage.until_state("ready")

    def world_waits(stage: Served) -> object:
        assert stage.service.machine is not None
        return stage.service.machine.modules.status()["heaters"]["waiting_for"]

    async def go() -> None:
        async with running(Served(tmp_path, lambda: world.description, world.host)) as stage:
            assert await stage.call("gcode.macros") == {"macros": [{"name": "WAVE", "help": "Wave the head"}]}
            stage.write_job(f"{picture}G4 P100\n")
            shown = await stage.call("job.thumbnail", file="job.gcode")
            assert shown == {"width": 8, "height": 8, "png": "iVBORw0KGgo="}
            assert (await stage.call("job.thumbnail", file="job.gcode", pixels_max=7))["png"] is None
            await stage.call("job.start", file="job.gcode")
            await stage.until_job("done")
            await waits(stage, "M190 S60", 60.0, 60.0)
            await waits(stage, "TEMPERATURE_WAIT SENSOR=heater_bed MINIMUM=40", 40.0, None)
        async with running(Served(tmp_path, lambda: world.description, world.host)) as stage:
            *stopped, done = (await stage.call("job.history"))["jobs"]
        assert [job["state"] for job in stopped] == ["stopped", "stopped"]
        assert stopped[0]["message"].startswith("emergency stop by")
        assert (done["file"], done["state"], done["message"]) == ("job.gcode", "done", "")
        assert done["elapsed_s"] >= 0.1

    world.run(go)
