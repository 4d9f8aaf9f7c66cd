"""The commands that talk to a machine: what they say, and what the machine is asked."""

import contextlib
import json
import os
import shutil
import socket
import subprocess
import sys
from collections.abc import AsyncIterator, Awaitable, Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import pytest

from coordinator.cli import main as cli
from coordinator.ipc.protocol.methods import Caller, Kind, Method, Param, Scope
from coordinator.ipc.server.uploads import PART_MAX, upload_method
from coordinator.web.methods import add_page_methods
from tests.coordinator.ipc.served import TOKENS, Served, plain_tcp, serving
from tests.stages import jump_loop
from tests.stages.loop_thread import in_thread
from tests.stages.own_sockets import own_sockets

if TYPE_CHECKING:
    from coordinator.web.server import WebServer

Command = Callable[..., tuple[int, str, str]]
CANDUCTOR = (sys.executable, "-m", "coordinator.cli.main")


@pytest.fixture
def canductor(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Command:
    """Return what carries out a command in this process: its status, and what it printed."""
    own_sockets(monkeypatch, tmp_path)

    def command(*words: str) -> tuple[int, str, str]:
        capsys.readouterr()
        status = cli.main(list(words))
        return (status, *capsys.readouterr())

    return command


@contextlib.contextmanager
def machine(folder: Path, **settings: Any) -> Iterator[Served]:
    """Serve a machine to commands, on a thread of its own."""
    jobs = folder / "jobs"
    jobs.mkdir()

    @contextlib.asynccontextmanager
    async def serve() -> AsyncIterator[Served]:
        async with serving(folder / "canductor", **settings) as served:
            registry = served.server._context.registry
            registry.add(upload_method(jobs))
            file = Param("file", Kind.STR)
            registry.add(
                Method("job.start", Scope.OPERATE, "Print.", lambda _, p: {"file": p["file"]}, (file,))
            )
            yield served

    with in_thread(serve) as served:
        yield served


def test_call_status_estop(tmp_path: Path, canductor: Command) -> None:
    with machine(tmp_path) as served:
        served.state.set("nodes.toolhead.state", "ready")
        status, out, _ = canductor("call", "move.to", "x_mm=5.5")
        assert (status, json.loads(out)) == (0, {"to": 5.5})
        status, out, err = canductor("call", "move.to", "x_mm=far", "--json")
        assert status == 1
        assert err == "canductor: move.to: x_mm is 'far', must be a number from 0 to 200 mm\n"
        assert json.loads(out) == {"ok": False, "error": err.removeprefix("canductor: ").strip()}
        status, out, _ = canductor("call", "node.command", 'command="5"', "--json")
        assert json.loads(out) == {"ok": True, "result": {"said": "5"}}
        status, out, _ = canductor("status")
        assert "nodes.toolhead.state = ready" in out
        status, out, _ = canductor("estop")
        assert (status, len(served.stops)) == (0, 1)


def test_links_to_the_page(tmp_path: Path, canductor: Command) -> None:
    with machine(tmp_path) as served:
        for words in (("page",), ("page", "--sign-out")):
            status, _, err = canductor(*words)
            assert (status, err) == (1, "canductor: the machine serves no live page; start it with --web\n")
        page = StandInPage()
        add_page_methods(served.server._context.registry, cast("WebServer", page))
        status, out, _ = canductor("page", "--watch")
        assert (status, out) == (0, f"{LINK}\nOpen it in a browser within 10 minutes; it works once.\n")
        assert canductor("page")[0] == 0
        assert page.asked == [Scope.WATCH, Scope.OPERATE]
        status, out, _ = canductor("page", "--sign-out")
        assert (status, out) == (0, "sessions of browsers that were ended: 7\n")
    status, _, err = canductor("page", "--sign-out", "--watch")
    assert (status, err.startswith("canductor: --sign-out prints no link")) == (2, True)


LINK = "http://127.0.0.1:8080/#code"


class StandInPage:
    """What a page is asked for; the page itself is tested with its server."""

    def __init__(self) -> None:
        self.asked: list[Scope] = []

    def new_link(self, scope: Scope) -> str:
        self.asked.append(scope)
        return LINK

    async def sign_all_out(self) -> int:
        return 7


def leave_socket(path: Path) -> str:
    """Leave a socket at PATH as a coordinator does that was killed."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as left:
        left.bind(str(path))
    return str(path)


def test_sockets_that_were_left_behind_stop_nobody(tmp_path: Path, canductor: Command) -> None:
    with machine(tmp_path) as served:
        live = served.at
        old = leave_socket(served.path.with_name("old.sock"))
        leave_socket(served.path.with_name("a.sock"))
        status, _, err = canductor("estop")
        assert (status, len(served.stops), err) == (0, 1, "")
        (tmp_path / "second" / "canductor").mkdir(parents=True)
        with machine(tmp_path / "second") as second:  # two that live: the dead are not offered
            second.path.rename(second_path := served.path.with_name("second.sock"))
            status, _, err = canductor("estop")
            assert (status, len(second.stops)) == (1, 0)
            assert err == (
                f"canductor: several machines run here; name one with --at: {live}, {second_path}\n"
            )
            # Once it answers, it has taken what looked whether it is there: asyncio loses a connection that
            # is accepted while its server closes.
            assert canductor("call", "machine.info", "--at", str(second_path))[0] == 0
            second_path.unlink()
        status, _, err = canductor("estop", "--at", old)
        assert (status, len(served.stops)) == (1, 1)
        left = "does not answer: a coordinator that ended left this socket; start one with canductor run\n"
        assert err == f"canductor: {old} {left}"
        assert canductor("call", "machine.info", "--at", live)[0] == 0  # as above


def test_where_nobody_answers(tmp_path: Path, canductor: Command) -> None:
    folder = tmp_path / "canductor"
    for name in ("old", "a"):
        leave_socket(folder / f"{name}.sock")
    _, _, err = canductor("status")  # two, and both are dead
    assert "a.sock does not answer: a coordinator that ended left this socket" in err
    (folder / "a.sock").unlink()
    (folder / "plain").touch()
    for at, sentence in (
        ((), "old.sock does not answer: a coordinator that ended left this socket; start one with"),
        (("--at", str(folder)), f"{folder} is a folder, not a socket; canductor discover lists"),
        (("--at", str(folder / "plain")), "plain is a file, not a socket"),
        (("--at", str(folder / "none")), "none does not answer: No such file or directory"),
    ):
        status, _, err = canductor("estop", *at)
        assert status == 1
        assert sentence in err


def test_a_token_that_others_can_read_is_not_used(tmp_path: Path, canductor: Command) -> None:
    token = tmp_path / "token"
    token.write_text(TOKENS[Scope.OPERATE] + "\n")

    with machine(tmp_path, tcp=plain_tcp(tmp_path)) as served:
        words = ("estop", "--at", f"tcp://127.0.0.1:{served.server.tcp_port}", "--token-file", str(token))
        for mode in (0o644, 0o640, 0o606):
            token.chmod(mode)
            status, _, err = canductor(*words)
            assert (status, len(served.stops)) == (1, 0)
            assert err == (
                f"canductor: the token's file {token} must belong to this user and be accessible to no other;"
                " chmod 600 it\n"
            )
        token.chmod(0o600)
        status, _, err = canductor(*words)
        assert (status, len(served.stops), err) == (0, 1, "")
        for text, sentence in (
            ("", "is empty; write the token into it"),
            ("\n \n", "is empty; write the token into it"),
            (f"operate me {TOKENS[Scope.OPERATE]}\n", "must hold one token, and nothing else"),
        ):
            token.write_text(text)
            status, _, err = canductor(*words)
            assert (status, err) == (1, f"canductor: the token's file {token} {sentence}\n")
        status, _, err = canductor(*words[:3])
        assert (status, len(served.stops)) == (1, 1)
        assert f"{words[2]} needs a token; give the file that holds it with --token-file" in err
        assert not served.server._throttle._failures  # nothing that is no token was sent as one


def test_watch(tmp_path: Path, canductor: Command) -> None:
    with machine(tmp_path) as served:
        served.state.update("a", {"x": 1.5, "y": "text", "z": None})
        status, out, err = canductor("watch", "a.*", "--count", "1")
        assert (status, out, err) == (0, "a.x = 1.5\na.y = text\na.z = null\n", "")
        status, out, _ = canductor("watch", "a.x", "--count", "1", "--json")
        first, last = map(json.loads, out.splitlines())
        assert first["values"] == {"a.x": 1.5}
        assert last == {"ok": True, "result": {"updates": 1}}


def test_watch_says_that_nothing_matches_and_goes_on(tmp_path: Path, canductor: Command) -> None:
    """The command is a process, so that it can be seen to wait."""
    with machine(tmp_path) as served:
        served.state.set("a.x", 1)
        with subprocess.Popen(
            [*CANDUCTOR, "watch", "nothing.*", "b", "--count", "2", "--at", served.at],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
        ) as process:
            assert process.stderr is not None
            told = process.stderr.readline()
            assert told == b"canductor: no field matches nothing.* b now; waiting for one that does\n"
            served.state.set("b", 2)
            out, err = process.communicate()
        assert (process.returncode, out, err) == (0, b"b = 2\n", b"")
        ended = canductor("watch", "nothing", "--count", "1")
        assert ended == (0, "", "canductor: no field matches nothing now\n")


def test_send(tmp_path: Path, canductor: Command) -> None:
    text = "G28 ; grüße\n" * (PART_MAX // 5)
    part = tmp_path / "part.gcode"
    part.write_text(text)

    with machine(tmp_path):
        status, out, err = canductor("send", str(part), "--json")
        assert (status, err) == (0, "")
        assert json.loads(out)["result"] == {"file": "part.gcode"}
        assert (tmp_path / "jobs" / "part.gcode").read_text() == text
        status, _, err = canductor("send", str(part))
        assert "exists already" in err
        assert (canductor("send", str(part), "--replace", "--no-start"))[0] == 0
        for name in ("../evil.gcode", ".hidden.gcode", "-x.gcode", "part.cfg", "a/b.gcode", "a\nb.gcode"):
            _, _, err = canductor("send", str(part), "--name=" + name)
            assert "must be a plain name" in err
        assert [path.name for path in (tmp_path / "jobs").iterdir()] == ["part.gcode"]


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
        assert "exists already" in await upload(file="b.gcode", offset=0, text="x", done=True)
        await upload(file="b.gcode", offset=0, text="new", done=True, replace=True)
        assert not (jobs / "b.gcode").is_symlink()
        assert "has 0 bytes so far" in await upload(file="c.gcode", offset=5, text="x")
        await upload(file="c.gcode", offset=0, text="12345")
        await upload(file="c.gcode", offset=0, text="abc")
        assert "has 3 bytes so far" in await upload(file="c.gcode", offset=5, text="x")
        await upload(file="c.gcode", offset=3, text="d", done=True)
        assert (jobs / "c.gcode").read_text() == "abcd"

    jump_loop.run(body())
    assert outside.read_text() == "precious"


def test_what_is_no_regular_file_is_not_sent(tmp_path: Path, canductor: Command) -> None:
    with machine(tmp_path):
        os.mkfifo(tmp_path / "pipe.gcode")
        for path in ("/dev/zero", str(tmp_path / "pipe.gcode")):
            status, _, err = canductor("send", path, "--name", "z.gcode")
            assert (status, f"'{path}' is not a regular file" in err) == (1, True), err
        assert list((tmp_path / "jobs").iterdir()) == []


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_completion_knows_every_command(canductor: Command, shell: str) -> None:
    status, out, _ = canductor("completion", shell)
    assert status == 0
    for word in ("simulate", "estop", "doctor", "--gcode", "--replace", "--sign-out"):
        assert word.removeprefix("--") in out
    if (program := shutil.which(shell)) is None:
        pytest.skip(f"{shell} is not installed: what was written for it was not run")
    checked = subprocess.run([program, "-n"], input=out, text=True, capture_output=True, check=False)
    assert checked.returncode == 0, checked.stderr
