"""The commands that talk to a machine, in processes of their own."""

import asyncio
import json
import os
import shutil
import subprocess
import sys
from collections.abc import Awaitable, Callable
from pathlib import Path

import pytest

from coordinator.ipc.methods import Caller, Kind, Method, Param, Scope
from coordinator.ipc.uploads import PART_MAX, upload_method
from tests.coordinator.ipc.served import Served, serving

CANDUCTOR = Path(sys.executable).parent / "canductor"


async def canductor(*words: str, folder: Path) -> tuple[int, str, str]:
    process = await asyncio.create_subprocess_exec(
        CANDUCTOR,
        *words,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        env=os.environ | {"XDG_RUNTIME_DIR": str(folder)},
    )
    out, err = await process.communicate()
    assert process.returncode is not None
    return process.returncode, out.decode(), err.decode()


def run(folder: Path, body: Callable[[Served], Awaitable[None]]) -> None:
    async def main() -> None:
        (folder / "canductor").mkdir()
        async with asyncio.timeout(60), serving(folder / "canductor") as served:
            registry = served.server._common.registry
            jobs = folder / "jobs"
            jobs.mkdir()
            registry.add(upload_method(jobs))
            file = Param("file", Kind.STR)
            registry.add(
                Method("job.start", Scope.OPERATE, "Print.", lambda _, p: {"file": p["file"]}, (file,))
            )
            await body(served)

    asyncio.run(main())


def test_call_status_estop(tmp_path: Path) -> None:
    async def body(served: Served) -> None:
        served.state.set("nodes.toolhead.state", "ready")
        status, out, _ = await canductor("call", "move.to", "x_mm=5.5", folder=tmp_path)
        assert (status, json.loads(out)) == (0, {"to": 5.5})
        status, out, err = await canductor("call", "move.to", "x_mm=far", "--json", folder=tmp_path)
        assert status == 1
        assert err == "canductor: move.to: x_mm is 'far', must be a number from 0 to 200 mm\n"
        assert json.loads(out) == {"ok": False, "error": err.removeprefix("canductor: ").strip()}
        status, out, _ = await canductor("call", "node.command", 'command="5"', "--json", folder=tmp_path)
        assert json.loads(out) == {"ok": True, "result": {"said": "5"}}
        status, out, _ = await canductor("status", folder=tmp_path)
        assert "nodes.toolhead.state = ready" in out
        status, out, _ = await canductor("estop", folder=tmp_path)
        assert (status, len(served.stops)) == (0, 1)

    run(tmp_path, body)


def test_watch(tmp_path: Path) -> None:
    async def body(served: Served) -> None:
        served.state.update("a", {"x": 1.5, "y": "text", "z": None})
        status, out, err = await canductor("watch", "a.*", "--count", "1", folder=tmp_path)
        assert (status, out, err) == (0, "a.x = 1.5\na.y = text\na.z = null\n", "")
        status, out, _ = await canductor("watch", "a.x", "--count", "1", "--json", folder=tmp_path)
        first, last = map(json.loads, out.splitlines())
        assert first["values"] == {"a.x": 1.5}
        assert last == {"ok": True, "result": {"updates": 1}}

    run(tmp_path, body)


def test_send(tmp_path: Path) -> None:
    text = "G28 ; grüße\n" * (PART_MAX // 5)
    part = tmp_path / "part.gcode"
    part.write_text(text)

    async def body(served: Served) -> None:
        del served
        status, out, err = await canductor("send", str(part), "--json", folder=tmp_path)
        assert (status, err) == (0, "")
        assert json.loads(out)["result"] == {"file": "part.gcode"}
        assert (tmp_path / "jobs" / "part.gcode").read_text() == text
        status, _, err = await canductor("send", str(part), folder=tmp_path)
        assert "is there already" in err
        assert (await canductor("send", str(part), "--replace", "--no-start", folder=tmp_path))[0] == 0
        for name in ("../evil.gcode", ".hidden.gcode", "-x.gcode", "part.cfg", "a/b.gcode", "a\nb.gcode"):
            _, _, err = await canductor("send", str(part), "--name=" + name, folder=tmp_path)
            assert "must be a plain name" in err
        assert [path.name for path in (tmp_path / "jobs").iterdir()] == ["part.gcode"]

    run(tmp_path, body)


def test_an_upload_follows_no_link_and_keeps_its_order(tmp_path: Path) -> None:
    outside = tmp_path / "outside"
    outside.write_text("precious")
    jobs = tmp_path / "jobs"
    jobs.mkdir()
    (jobs / ".a.gcode.part").symlink_to(outside)
    (jobs / "b.gcode").symlink_to(outside)

    async def body() -> None:
        method = upload_method(jobs)

        async def upload(**params: object) -> str:
            try:
                result = method.call(Caller("test", Scope.OPERATE), method.check(params))
                assert isinstance(result, Awaitable)
                return str(await result)
            except Exception as error:  # noqa: BLE001 (each is looked at)
                return str(error)

        assert "cannot be written" in await upload(file="a.gcode", offset=0, text="x", done=True)
        assert "is there already" in await upload(file="b.gcode", offset=0, text="x", done=True)
        await upload(file="b.gcode", offset=0, text="new", done=True, replace=True)
        assert not (jobs / "b.gcode").is_symlink()
        assert "has 0 bytes so far" in await upload(file="c.gcode", offset=5, text="x")
        await upload(file="c.gcode", offset=0, text="12345")
        await upload(file="c.gcode", offset=0, text="abc")
        assert "has 3 bytes so far" in await upload(file="c.gcode", offset=5, text="x")
        await upload(file="c.gcode", offset=3, text="d", done=True)
        assert (jobs / "c.gcode").read_text() == "abcd"

    asyncio.run(body())
    assert outside.read_text() == "precious"


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_completion_knows_every_command(tmp_path: Path, shell: str) -> None:
    status, out, _ = asyncio.run(canductor("completion", shell, folder=tmp_path))
    assert status == 0
    for word in ("simulate", "estop", "doctor", "--gcode", "--replace"):
        assert word.removeprefix("--") in out
    if (program := shutil.which(shell)) is None:
        pytest.skip(f"{shell} is not installed: what was written for it was not run")
    checked = subprocess.run([program, "-n"], input=out, text=True, capture_output=True, check=False)
    assert checked.returncode == 0, checked.stderr


def test_planning_does_not_pay_for_the_interface() -> None:
    code = (
        "import sys; from coordinator.cli import main; main(['plan', '--help']);"
        "sys.exit(any(m.split('.')[0] in ('msgpack', 'shtab', 'asyncio') or 'ipc' in m for m in sys.modules))"
    )
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, check=False).returncode == 0
