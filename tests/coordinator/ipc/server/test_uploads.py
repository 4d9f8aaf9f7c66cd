"""Files that clients begin to send and do not end."""

import asyncio
import os
import shutil
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Any

import pytest

from coordinator.ipc.protocol.methods import ApiError
from coordinator.ipc.server.uploads import FREE_MIN, PARTS_MAX, _show, upload_method
from tests.coordinator.ipc.served import Script, Served, serving
from tests.stages import jump_loop


def run(folder: Path, body: Callable[[Served, Path], Awaitable[None]]) -> None:
    async def main() -> None:
        async with serving(folder) as served:
            jobs = folder / "jobs"
            jobs.mkdir(exist_ok=True)
            served.server._context.registry.add(upload_method(jobs))
            await body(served, jobs)

    jump_loop.run(main())


async def upload(script: Script, file: str, offset: int, text: str, **more: Any) -> Any:
    answer = await script.ask("job.upload", file=file, offset=offset, text=text, **more)
    return answer["result"]["size_bytes"] if "result" in answer else answer["error"]


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


async def until(folder: Path, wanted: list[str]) -> None:
    while names(folder) != wanted:  # noqa: ASYNC110 (a folder tells nobody)
        await asyncio.sleep(0.01)


def test_a_file_that_is_not_complete_goes_with_its_client(tmp_path: Path) -> None:
    async def body(served: Served, jobs: Path) -> None:
        script = await served.script()
        assert await upload(script, "a.gcode", 0, "G28\n") == 4
        assert await upload(script, "b.gcode", 0, "G28\n", done=True) == 4
        assert names(jobs) == [".a.gcode.part", "b.gcode"]
        script.writer.close()
        await until(jobs, ["b.gcode"])
        other = await served.script()
        assert "start over" in (await upload(other, "a.gcode", 4, "x"))["message"]

    run(tmp_path, body)


def test_a_part_is_its_clients_alone(tmp_path: Path) -> None:
    async def body(served: Served, jobs: Path) -> None:
        script, other = await served.script(), await served.script()
        assert await upload(script, "a.gcode", 0, "12") == 2
        for offset in (0, 2):
            assert (await upload(other, "a.gcode", offset, "x"))["code"] == "busy"
        assert await upload(script, "a.gcode", 2, "34", done=True) == 4
        assert (jobs / "a.gcode").read_text() == "1234"
        assert await upload(other, "a.gcode", 0, "x", replace=True) == 1

    run(tmp_path, body)


def test_only_so_many_at_a_time(tmp_path: Path) -> None:
    async def body(served: Served, jobs: Path) -> None:
        script = await served.script()
        for number in range(PARTS_MAX):
            await upload(script, "0.gcode", 0, "", done=True, replace=True)
            assert (await upload(script, "0.gcode", 0, ""))["code"] == "file_exists", "is no part of a file"
            assert await upload(script, f"a{number}.gcode", 0, "x") == 1
        refused = await upload(script, "b.gcode", 0, "x")
        assert (refused["code"], str(PARTS_MAX) in refused["message"]) == ("busy", True)
        await upload(script, "a0.gcode", 1, "x", done=True)
        assert await upload(script, "b.gcode", 0, "x") == 1
        assert len(names(jobs)) == PARTS_MAX + 2

    run(tmp_path, body)


def test_the_disk_is_never_filled(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    async def body(served: Served, jobs: Path) -> None:
        script = await served.script()
        assert await upload(script, "a.gcode", 0, "x") == 1
        full = shutil.disk_usage(tmp_path)._replace(free=FREE_MIN)
        monkeypatch.setattr(shutil, "disk_usage", lambda _: full)
        refused = await upload(script, "a.gcode", 1, "x")
        assert (refused["code"], "MiB left" in refused["message"]) == ("failed", True)
        await until(jobs, [])

    run(tmp_path, body)


def test_what_a_killed_service_left_is_removed_and_nothing_else(tmp_path: Path) -> None:
    jobs = tmp_path / "jobs"
    jobs.mkdir()
    kept = ["a.gcode", ".notes.part", "b.gcode.part", ".link.gcode.part"]
    for name in (".z.gcode.part", *kept[:3]):
        (jobs / name).write_text("x")
    (jobs / kept[3]).symlink_to(jobs / "a.gcode")

    async def body(_: Served, jobs: Path) -> None:
        assert names(jobs) == sorted(kept)

    run(tmp_path, body)


def test_a_file_that_appears_at_the_last_moment_stays(tmp_path: Path) -> None:
    """Failed before: between the look and the rename it was overwritten."""
    (tmp_path / ".a.gcode.part").write_text("new")
    (tmp_path / "a.gcode").write_text("old")
    folder = os.open(tmp_path, os.O_RDONLY)
    try:
        with pytest.raises(ApiError, match="exists already"):
            _show(folder, ".a.gcode.part", "a.gcode", replace=False)
        assert (tmp_path / "a.gcode").read_text() == "old"
        _show(folder, ".a.gcode.part", "a.gcode", replace=True)
    finally:
        os.close(folder)
    assert {path.name: path.read_text() for path in tmp_path.iterdir()} == {"a.gcode": "new"}
