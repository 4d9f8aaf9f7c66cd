"""Jobs whose lines come from a client, in virtual time: of any length, paused, cancelled, broken off."""

import asyncio
import random
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Any

import pytest

from coordinator.ipc.protocol.methods import ApiError
from coordinator.service.jobs.fed import LINES_AHEAD_MAX
from coordinator.service.jobs.journal import NAME, Journal, journal_path
from coordinator.simulate.scenario import load
from coordinator.simulate.stage import Stage
from tests.stages.served import Served, running

CLEAN = Path("coordinator/simulate/scenarios/clean.toml")
HEAD = ["G28", "G90", "G1 X50 Y50 F6000"]


def steps(count: int, seed: int) -> list[str]:
    """Return lines of short moves, some 25 ms each."""
    chance = random.Random(seed)
    return [
        f"G1 X{50 + chance.uniform(-1, 1):.3f} Y{50 + chance.uniform(-1, 1):.3f} F6000" for _ in range(count)
    ]


def play(folder: Path, body: Callable[[Served], Awaitable[None]], seed: int = 1) -> None:
    """Run BODY with a machine of virtual nodes that is ready."""
    world = Stage(load(CLEAN), seed)

    async def go() -> None:
        async with running(Served(folder, lambda: world.description, world.host)) as stage:
            await body(stage)

    with asyncio.Runner(loop_factory=world.make_loop) as runner:
        runner.run(go())


class Fed:
    """A job JOB of STAGE, and who feeds it."""

    def __init__(self, stage: Served) -> None:
        self.stage = stage
        self.sent = 0
        self.over = asyncio.ensure_future(stage.call("job.stream", name="JOB"))

    async def feed(self, *lines: str, **more: Any) -> None:
        await asyncio.sleep(0)  # the job begins
        text = "".join(line + "\n" for line in lines)
        told = await self.stage.call("job.feed", name="JOB", first_line=self.sent + 1, text=text, **more)
        self.sent += len(lines)
        assert told == {"lines": self.sent}

    async def feed_all(self, lines: list[str], piece: int = 40) -> None:
        for at in range(0, len(lines), piece):
            await self.feed(*lines[at : at + piece])
            job = self.stage.service.job
            assert job is not None
            ahead = self.sent - job.lines_read
            assert ahead <= 2 * LINES_AHEAD_MAX + piece, "more waits than was promised"


def ends_at(stage: Served, line: str) -> None:
    _, x, y, *_ = line.split()
    assert (f"X{stage.planned[0]:.3f}", f"Y{stage.planned[1]:.3f}") == (x, y)


def test_more_lines_than_anything_holds_with_pauses(tmp_path: Path) -> None:
    lines = HEAD + steps(900, 1)

    async def body(stage: Served) -> None:
        job = Fed(stage)
        feeding = asyncio.ensure_future(job.feed_all(lines))
        for _ in range(2):
            await asyncio.sleep(4)
            await stage.call("job.pause")
            await stage.until_job("paused")
            before = await stage.check_positions()
            await asyncio.sleep(8)
            sent = job.sent
            assert sent < len(lines), "nothing held the feeder back"
            await asyncio.sleep(8)
            assert job.sent == sent, "a paused job goes on taking lines"
            assert await stage.check_positions() == before
            told = await stage.call("job.status")
            assert told["lines_fed"] >= sent
            assert 0 < told["line"] < sent
            assert told["progress"] == 0.0
            await stage.call("job.resume")
        await feeding
        await job.feed(end=True)
        told = await job.over
        assert (told["state"], told["message"], told["progress"]) == ("done", "", 1.0)
        assert (told["lines_fed"], told["file"]) == (len(lines), "JOB")
        ends_at(stage, lines[-1])
        await stage.check_positions()
        assert str(stage.service.state) == "ready"

    play(tmp_path, body)


@pytest.mark.parametrize(("paused", "leaves"), [(False, True), (True, False)])
def test_whatever_came_is_carried_out_when_no_more_comes(tmp_path: Path, paused: bool, leaves: bool) -> None:
    lines = HEAD + steps(90, 2)

    async def body(stage: Served) -> None:
        job = Fed(stage)
        await job.feed(*lines)
        await stage.until(lambda: bool(stage.tree.get("job.line")), "motion")
        if paused:
            await stage.call("job.pause")
            await stage.until_job("paused")
        if leaves:
            job.over.cancel()
        else:
            await job.feed(failure="nothing was received after line 93 in time")
        if paused:
            await asyncio.sleep(10)
            assert stage.job_state == "paused"
            assert any("no more" in line or "line 93" in line for line in stage.lines)
            await stage.call("job.resume")
        await stage.until_job("failed")
        why = "the client 'a test' left" if leaves else "nothing was received after line 93 in time"
        told = await stage.call("job.status")
        assert told["message"] == f"JOB: {why}; all that came, to line 93, is carried out"
        ends_at(stage, lines[-1])
        await stage.check_positions()
        assert str(stage.service.state) == "ready"
        again = Fed(stage)  # nothing of it is left behind
        await again.feed("G1 X10 Y10", end=True)
        assert (await again.over)["state"] == "done"

    play(tmp_path, body)


def test_a_feeder_that_is_slow_lets_the_machine_stand_between_moves(tmp_path: Path) -> None:
    async def body(stage: Served) -> None:
        job = Fed(stage)
        await job.feed(*HEAD)
        motion = stage.service.motion
        assert motion is not None
        for line in steps(4, 3):
            await stage.until(lambda: motion.standing, "a standstill")
            await job.feed(line)
            await stage.until(lambda: not motion.standing, "motion")
        await job.feed(end=True)
        assert (await job.over)["state"] == "done"
        await stage.check_positions()

    play(tmp_path, body)


def test_cancel(tmp_path: Path) -> None:
    async def body(stage: Served) -> None:
        job = Fed(stage)
        feeding = asyncio.ensure_future(job.feed_all(HEAD + steps(4000, 4)))
        await stage.until(lambda: bool(stage.tree.get("job.line")), "motion")
        await stage.call("job.cancel")
        with pytest.raises(ApiError, match="JOB was cancelled at the machine"):
            await feeding
        assert (await job.over)["state"] == "cancelled"
        with pytest.raises(ApiError, match="JOB was cancelled at the machine"):
            await job.feed("G1 X1")
        await stage.check_positions()

    play(tmp_path, body)


def test_a_line_that_cannot_be_carried_out(tmp_path: Path) -> None:
    async def body(stage: Served) -> None:
        job = Fed(stage)
        await job.feed(*HEAD, "G1 X9999", "G1 X1")
        told = await job.over
        assert told["state"] == "failed"
        assert told["message"].startswith("JOB:4: ")
        with pytest.raises(ApiError) as error:
            await job.feed("G1 X2")
        assert str(error.value) == told["message"]

    play(tmp_path, body)


def test_the_machine_stops(tmp_path: Path) -> None:
    async def body(stage: Served) -> None:
        job = Fed(stage)
        feeding = asyncio.ensure_future(job.feed_all(HEAD + steps(4000, 4)))
        await stage.until(lambda: bool(stage.tree.get("job.line")), "motion")
        await stage.call("machine.emergency_stop")
        with pytest.raises(ApiError, match="emergency stop by 'a test'"):
            await feeding
        assert (await job.over)["state"] == "stopped"
        assert (await stage.call("job.status"))["message"] == "emergency stop by 'a test'"
        assert stage.tree.get("job.interrupted_file") == "JOB"
        with pytest.raises(ApiError, match="the machine stopped"):
            await stage.call("job.stream", name="JOB")

    play(tmp_path, body)


def test_what_is_refused(tmp_path: Path) -> None:
    async def body(stage: Served) -> None:
        with pytest.raises(ApiError, match="there is no job JOB that is fed"):
            await stage.call("job.feed", name="JOB", first_line=1, text="G28\n")
        with pytest.raises(ApiError, match="is no name for a job"):
            await stage.call("job.stream", name="\n")
        job = Fed(stage)
        await job.feed("G28")
        for first_line in (1, 3):  # once more, and left out
            with pytest.raises(ApiError, match=f"has 1 lines so far, line {first_line} cannot come next"):
                await stage.call("job.feed", name="JOB", first_line=first_line, text="G1 X1\n")
        with pytest.raises(ApiError, match="2000 lines; at most 1024 at once"):
            await stage.call("job.feed", name="JOB", first_line=2, text="\n" * 2000)
        with pytest.raises(ApiError, match="the machine is busy"):
            await stage.call("job.stream", name="OTHER")
        await stage.call("job.pause")
        waiting = asyncio.ensure_future(job.feed(*["; nothing"] * 1000))
        await asyncio.sleep(1)
        assert not waiting.done(), "there was no room"
        with pytest.raises(ApiError, match="takes no lines now"):
            await stage.call("job.feed", name="JOB", first_line=1002, text="G1 X1\n")
        await stage.call("job.resume")
        await waiting
        await job.feed(end=True)
        assert (await job.over)["state"] == "done"

    play(tmp_path, body)


def test_after_a_crash_it_is_told_and_cannot_be_recovered(tmp_path: Path) -> None:
    (tmp_path / "jobs").mkdir()
    old = tmp_path / "jobs" / NAME  # where earlier versions kept it
    journal = Journal(old, lambda _: None)
    journal.begin("JOB", 0, 0, fed=True)
    journal.note(17, {})
    journal.close()

    async def body(stage: Served) -> None:
        assert stage.tree.get("job.interrupted_line") == 17
        assert not old.exists(), "front ends list that folder"
        assert journal_path(tmp_path / "state", tmp_path / "jobs").exists()
        assert any(
            "JOB was interrupted at line 17; its lines came from a client" in line for line in stage.lines
        )
        await stage.call("gcode.run", script="G28")
        with pytest.raises(ApiError, match="there is no file to go on with; have them sent again"):
            await stage.call("job.recover")
        job = Fed(stage)
        await job.feed(*HEAD, end=True)
        assert (await job.over)["state"] == "done"
        assert stage.tree.get("job.interrupted_file") is None

    play(tmp_path, body)
