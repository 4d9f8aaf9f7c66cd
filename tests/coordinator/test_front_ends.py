"""The commands that talk to a machine, in processes of their own."""

import asyncio
import json
import os
import re
import shutil
import socket
import subprocess
import sys
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Any

import pytest

from coordinator.ipc.methods import Caller, Kind, Method, Param, Scope
from coordinator.ipc.uploads import PART_MAX, upload_method
from coordinator.web.methods import add_page_methods
from coordinator.web.server import WebServer
from coordinator.web.settings import WebSettings
from tests.coordinator.ipc.served import TOKENS, Served, plain_tcp, serving

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


def run(folder: Path, body: Callable[[Served], Awaitable[None]], **settings: Any) -> None:
    async def main() -> None:
        (folder / "canductor").mkdir(exist_ok=True)
        async with asyncio.timeout(60), serving(folder / "canductor", **settings) as served:
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


def test_links_to_the_page(tmp_path: Path) -> None:
    async def body(served: Served) -> None:
        for words in (("page",), ("page", "--sign-out")):
            status, _, err = await canductor(*words, folder=tmp_path)
            assert (status, err) == (1, "canductor: the machine serves no live page; start it with --web\n")
        page = WebServer(served.server, WebSettings(host="127.0.0.1", port=0))
        add_page_methods(served.server._common.registry, page)
        await page.start()
        status, out, _ = await canductor("page", "--watch", folder=tmp_path)
        assert status == 0
        link, sentence = out.splitlines()
        assert re.fullmatch(rf"http://127\.0\.0\.1:{page.port}/#[\w-]{{43}}", link)
        assert sentence == "Open it in a browser within 10 minutes; it works once."
        status, out, _ = await canductor("page", "--sign-out", folder=tmp_path)
        assert (status, out) == (0, "sessions of browsers that were ended: 0\n")
        status, _, err = await canductor("page", "--sign-out", "--watch", folder=tmp_path)
        assert (status, err.startswith("canductor: --sign-out prints no link")) == (2, True)
        await page.close()

    run(tmp_path, body)


def leave_socket(path: Path) -> str:
    """Leave a socket at PATH as a coordinator does that was killed."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as left:
        left.bind(str(path))
    return str(path)


def test_sockets_that_were_left_behind_stop_nobody(tmp_path: Path) -> None:
    async def body(served: Served) -> None:
        live = served.at
        old = leave_socket(served.path.with_name("old.sock"))
        leave_socket(served.path.with_name("a.sock"))
        status, _, err = await canductor("estop", folder=tmp_path)
        assert (status, len(served.stops), err) == (0, 1, "")
        async with serving(served.path.parent / "b") as second:  # two that live: the dead are not offered
            second.path.rename(second_path := served.path.with_name("second.sock"))
            status, _, err = await canductor("estop", folder=tmp_path)
            assert (status, len(second.stops)) == (1, 0)
            assert err == (
                f"canductor: several machines run here; name one with --at: {live}, {second_path}\n"
            )
            second_path.unlink()
        status, _, err = await canductor("estop", "--at", old, folder=tmp_path)
        assert (status, len(served.stops)) == (1, 1)
        left = "does not answer: a coordinator that ended left this socket; start one with canductor run\n"
        assert err == f"canductor: {old} {left}"

    (tmp_path / "canductor" / "b").mkdir(parents=True)
    run(tmp_path, body)

    async def alone() -> None:
        _, _, err = await canductor("status", folder=tmp_path)  # two, and both are dead
        assert "a.sock does not answer: a coordinator that ended left this socket" in err
        folder = tmp_path / "canductor"
        (folder / "a.sock").unlink()
        (folder / "plain").touch()
        for at, sentence in (
            ((), "old.sock does not answer: a coordinator that ended left this socket; start one with"),
            (("--at", str(folder)), f"{folder} is a folder, not a socket; canductor discover lists"),
            (("--at", str(folder / "plain")), "plain is a file, not a socket"),
            (("--at", str(folder / "none")), "none does not answer: No such file or directory"),
        ):
            status, _, err = await canductor("estop", *at, folder=tmp_path)
            assert status == 1
            assert sentence in err

    asyncio.run(alone())


def test_a_token_that_others_can_read_is_not_used(tmp_path: Path) -> None:
    token = tmp_path / "token"
    token.write_text(TOKENS[Scope.OPERATE] + "\n")

    async def body(served: Served) -> None:
        words = ("estop", "--at", f"tcp://127.0.0.1:{served.server.tcp_port}", "--token-file", str(token))
        for mode in (0o644, 0o640, 0o606):
            token.chmod(mode)
            status, _, err = await canductor(*words, folder=tmp_path)
            assert (status, len(served.stops)) == (1, 0)
            assert err == (
                f"canductor: the token's file {token} must be yours alone; chmod 600 it, and own it\n"
            )
        token.chmod(0o600)
        status, _, err = await canductor(*words, folder=tmp_path)
        assert (status, len(served.stops), err) == (0, 1, "")
        for text, sentence in (
            ("", "is empty; write the token into it"),
            ("\n \n", "is empty; write the token into it"),
            (f"operate me {TOKENS[Scope.OPERATE]}\n", "must hold one token, and nothing else"),
        ):
            token.write_text(text)
            status, _, err = await canductor(*words, folder=tmp_path)
            assert (status, err) == (1, f"canductor: the token's file {token} {sentence}\n")
        status, _, err = await canductor(*words[:3], folder=tmp_path)
        assert (status, len(served.stops)) == (1, 1)
        assert f"{words[2]} wants a token; name the file that holds it with --token-file" in err
        assert not served.server._brake._failures  # nothing that is no token was sent as one

    run(tmp_path, body, tcp=plain_tcp(tmp_path))


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


def test_watch_says_that_nothing_matches_and_goes_on(tmp_path: Path) -> None:
    async def body(served: Served) -> None:
        served.state.set("a.x", 1)
        process = await asyncio.create_subprocess_exec(
            *(CANDUCTOR, "watch", "nothing.*", "b", "--count", "2"),
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            env=os.environ | {"XDG_RUNTIME_DIR": str(tmp_path)},
        )
        assert process.stderr is not None
        told = await process.stderr.readline()
        assert told == b"canductor: no field matches nothing.* b now; waiting for one that does\n"
        served.state.set("b", 2)
        out, err = await process.communicate()
        assert (process.returncode, out, err) == (0, b"b = 2\n", b"")
        ended = await canductor("watch", "nothing", "--count", "1", folder=tmp_path)
        assert ended == (0, "", "canductor: no field matches nothing now\n")

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
        method, caller = upload_method(jobs), Caller("test", Scope.OPERATE)

        async def upload(**params: object) -> str:
            try:
                result = method.call(caller, method.check(params))
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


def test_what_is_no_regular_file_is_not_sent(tmp_path: Path) -> None:
    async def body(served: Served) -> None:
        del served
        os.mkfifo(tmp_path / "pipe.gcode")
        for path in ("/dev/zero", str(tmp_path / "pipe.gcode")):
            status, _, err = await canductor("send", path, "--name", "z.gcode", folder=tmp_path)
            assert (status, f"{path} is no regular file" in err) == (1, True), err
        assert list((tmp_path / "jobs").iterdir()) == []

    run(tmp_path, body)


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_completion_knows_every_command(tmp_path: Path, shell: str) -> None:
    status, out, _ = asyncio.run(canductor("completion", shell, folder=tmp_path))
    assert status == 0
    for word in ("simulate", "estop", "doctor", "--gcode", "--replace", "--sign-out"):
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
