"""A job file that is changed, cut or replaced while it prints, with a wall clock that jumps; virtual time."""

import asyncio
import os
import time
from collections.abc import Callable
from itertools import cycle
from pathlib import Path

import pytest

from coordinator.gcode.program import CHUNK_BYTES
from coordinator.simulate.scenario import load
from coordinator.simulate.stage import Stage
from tests.stages.served import Served, running

CLEAN = Path("coordinator/simulate/scenarios/clean.toml")
FILLER = "; " + "x" * 2000
"""So that few moves take several pieces of the file."""
MOVES = 240


def job(end_mm: int) -> str:
    lines = ["G28", "G90", "G1 Z1 F900"]
    lines += [f"G1 X{20 + n % 2} Y20 F6000 {FILLER}" for n in range(MOVES)]
    return "\n".join([*lines, f"G1 X{end_mm} F6000", ""])


@pytest.fixture
def jumping_clock(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the wall clock jump by years, to and fro, each time it is read."""
    steps = cycle((-1e8, 0.0, 2e8, -86_400.0))
    real = time.time
    monkeypatch.setattr(time, "time", lambda: real() + next(steps))
    monkeypatch.setattr(time, "time_ns", lambda: int((real() + next(steps)) * 1e9))


def cut(path: Path) -> None:
    os.truncate(path, CHUNK_BYTES + 100)


def change(path: Path) -> None:
    data = path.read_bytes().replace(b"X30", b"X90")
    with path.open("r+b") as file:
        file.write(data)


def replace(path: Path) -> None:
    path.with_suffix(".new").write_text(job(90))
    path.with_suffix(".new").replace(path)


def remove(path: Path) -> None:
    path.unlink()


CASES: dict[Callable[[Path], None], str] = {
    cut: f"was truncated to {CHUNK_BYTES + 100:,} bytes while it was being printed",
    change: "was changed while it was being printed",
    replace: "",
    remove: "",
}
"""What the message says; empty: the job goes on with the file that was opened."""


@pytest.mark.usefixtures("jumping_clock")
def test_nothing_of_a_changed_file_is_carried_out(tmp_path: Path) -> None:
    """Failed before for the first two: a shorter file counted as done, another content was carried out."""
    assert len(job(30)) > 3 * CHUNK_BYTES
    world = Stage(load(CLEAN), 1)

    async def go() -> None:
        async with running(Served(tmp_path, lambda: world.description, world.host)) as stage:
            for act, message in CASES.items():
                await stage.homing_comes()
                path = stage.jobs / stage.write_job(job(30))
                await stage.call("job.start", file=path.name)
                await stage.until(lambda: int(str(stage.tree.get("job.line") or 0)) > 5, "the first lines")
                act(path)
                await stage.until_job("failed" if message else "done")
                assert stage.service.job is not None
                assert message in stage.service.job.message
                await stage.check_positions()
                if not message:
                    assert stage.planned[0] == pytest.approx(30), "the file that was opened"
                assert str(stage.service.state) == "ready"
                await stage.call("gcode.run", script="G1 X25 F6000")

    with asyncio.Runner(loop_factory=world.make_loop) as runner:
        runner.run(go())
