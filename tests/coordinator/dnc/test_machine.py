"""A received program becomes a job of a machine that runs; a dripped one is carried out line by line."""

import asyncio
import os
import subprocess
import threading
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Any

import pytest

from coordinator.dnc.feeds import MachineSink
from coordinator.dnc.files import FileRefused
from coordinator.ipc.methods import ApiError, Caller, Kind, Method, Param, Scope, Value
from coordinator.ipc.uploads import upload_method
from tests.coordinator.dnc.cable import Cable
from tests.coordinator.dnc.test_commands import CANDUCTOR, FAST, PROGRAM, started
from tests.coordinator.ipc.served import Served, serving


def run_with_machine(folder: Path, body: Callable[[Served, list[Any]], Awaitable[None]]) -> None:
    """Serve an interface with a job folder that notes what is started and run."""

    async def main() -> None:
        (folder / "canductor").mkdir()
        done: list[Any] = []
        async with asyncio.timeout(60), serving(folder / "canductor") as served:
            registry = served.server._common.registry
            (folder / "jobs").mkdir()
            registry.add(upload_method(folder / "jobs"))

            def start(_: Caller, params: dict[str, Any]) -> Value:
                done.append(params["file"])
                return {}

            def run(_: Caller, params: dict[str, Any]) -> Value:
                if "G99" in params["script"]:
                    raise ApiError("bad_gcode", "G99 is not known")
                done.append((params["script"], params["wait"]))
                return {}

            registry.add(Method("job.start", Scope.OPERATE, "", start, (Param("file", Kind.STR),)))
            script = (Param("script", Kind.STR), Param("wait", Kind.BOOL))
            registry.add(Method("gcode.run", Scope.OPERATE, "", run, script))
            await body(served, done)

    asyncio.run(main())


async def command(*words: str, folder: Path) -> tuple[int, str]:
    process = await asyncio.create_subprocess_exec(
        CANDUCTOR,
        "dnc",
        *words,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        cwd=folder,
        env=os.environ | {"XDG_RUNTIME_DIR": str(folder)},
    )
    _, err = await process.communicate()
    assert process.returncode is not None
    return process.returncode, err.decode()


def test_receive_and_start(tmp_path: Path) -> None:
    (tmp_path / "part.nc").write_bytes(PROGRAM)

    async def body(_: Served, done: list[Any]) -> None:
        inbox = tmp_path / "inbox"
        inbox.mkdir()
        with Cable() as cable, started("serve", ".", "-p", cable.names[0], *FAST, folder=tmp_path):
            words = ("receive", "PART", "--folder", "inbox", "--start", "-p", cable.names[1], *FAST)
            assert await command(*words, folder=tmp_path) == (0, "")
        assert done == ["PART.nc"]
        assert (tmp_path / "jobs" / "PART.nc").read_bytes() == PROGRAM
        assert (inbox / "PART.nc").read_bytes() == PROGRAM

    run_with_machine(tmp_path, body)


@pytest.mark.parametrize("bad", [False, True])
def test_drip_to_the_machine(tmp_path: Path, bad: bool) -> None:
    lines = ["%", "G1 X1", "", "G99" if bad else "G1 X2", "G1 X3"]
    (tmp_path / "job.nc").write_text("\n".join(lines) + "\n")

    async def body(_: Served, done: list[Any]) -> None:
        with Cable() as cable, started("serve", ".", "-p", cable.names[0], *FAST, folder=tmp_path):
            status, err = await command("drip", "--from", "JOB", "-p", cable.names[1], *FAST, folder=tmp_path)
        if bad:
            assert (status, err) == (1, "canductor: JOB: G99 is not known\n")
            assert done == [("G1 X1", False)]
        else:
            assert (status, err) == (0, "")
            assert done == [(line, False) for line in lines if line not in ("", "%")]

    run_with_machine(tmp_path, body)


def test_a_sink_waits_for_the_machine() -> None:
    """Flow control: a line counts as taken when the machine has answered."""
    answered = threading.Event()
    called = threading.Event()

    def call(_method: str, _params: object) -> None:
        called.set()
        assert answered.wait(60)

    sink = MachineSink(call, "JOB")
    writing = threading.Thread(target=sink.write, args=(b"G1 X1",))
    writing.start()
    assert called.wait(60)
    assert writing.is_alive()
    answered.set()
    writing.join(60)
    assert not writing.is_alive()
    with pytest.raises(FileRefused, match="not ASCII"):
        sink.write(b"\xc4")
