"""A received program becomes a job of a machine that runs; a dripped one is a job while it comes."""

import asyncio
import os
import subprocess
from collections.abc import Awaitable, Callable, Mapping
from concurrent.futures import Future
from pathlib import Path
from typing import Any

import pytest

from coordinator.dnc.blocks import SOH, STX, write_block
from coordinator.dnc.desk import Desk
from coordinator.dnc.engine import Engine, State
from coordinator.dnc.files import FileRefused
from coordinator.dnc.machine import LINES_MAX, MachineSink
from coordinator.dnc.options import DncOptions
from coordinator.ipc.methods import ApiError, Caller, Kind, Method, Param, Scope, Value
from coordinator.ipc.uploads import upload_method
from tests.coordinator.dnc.cable import Cable
from tests.coordinator.dnc.test_commands import CANDUCTOR, FAST, PROGRAM, started
from tests.coordinator.ipc.served import TOKENS, Served, plain_tcp, serving


class Job:
    """What the machine prints."""

    def __init__(self) -> None:
        self.name = ""
        self.lines: list[str] = []
        self.over = asyncio.Event()
        self.how: dict[str, Any] = {}

    async def stream(self, _: Caller, params: dict[str, Any]) -> Value:
        self.name = params["name"]
        await self.over.wait()
        return self.how

    def feed(self, _: Caller, params: dict[str, Any]) -> Value:
        if self.over.is_set():
            raise ApiError("no_job", "there is no job")
        assert params["first_line"] == len(self.lines) + 1
        for line in params["text"].splitlines():
            self.lines.append(line)
            if "G99" in line:
                self.end("failed", f"{self.name}:{len(self.lines)}: G99 is not known")
        if params["failure"] is not None:
            self.end("failed", params["failure"])
        elif params["end"]:
            self.end("done", "")
        return {"lines": len(self.lines)}

    def end(self, state: str, message: str) -> None:
        self.how = {"state": state, "message": message}
        self.over.set()


def run_with_machine(
    folder: Path, body: Callable[[Served, list[str], Job], Awaitable[None]], **settings: Any
) -> None:
    """Serve an interface with a job folder that notes what is started, and a job that is fed."""

    async def main() -> None:
        (folder / "canductor").mkdir()
        begun: list[str] = []
        async with asyncio.timeout(60), serving(folder / "canductor", **settings) as served:
            registry = served.server._common.registry
            (folder / "jobs").mkdir()
            registry.add(upload_method(folder / "jobs"))
            job = Job()

            def start(_: Caller, params: dict[str, Any]) -> Value:
                if begun:
                    raise ApiError("busy", "the machine is busy")
                begun.append(params["file"])
                return {}

            registry.add(Method("job.start", Scope.OPERATE, "", start, (Param("file", Kind.STR),)))
            name, text = Param("name", Kind.STR), Param("text", Kind.STR)
            first_line = Param("first_line", Kind.INT)
            end = Param("end", Kind.BOOL, required=False, default=False)
            failure = Param("failure", Kind.STR, required=False)
            registry.add(Method("job.stream", Scope.OPERATE, "", job.stream, (name,)))
            params = (name, first_line, text, end, failure)
            registry.add(Method("job.feed", Scope.OPERATE, "", job.feed, params))
            await body(served, begun, job)

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


@pytest.mark.parametrize("tcp", [False, True])
def test_receive_and_start(tmp_path: Path, tcp: bool) -> None:
    """Over a Unix socket, and over TCP with a token; when it cannot be started, it is there all the same."""
    (tmp_path / "part.nc").write_bytes(PROGRAM)
    for name, token in (("right", TOKENS[Scope.OPERATE]), ("weak", TOKENS[Scope.WATCH]), ("wrong", "x" * 40)):
        (tmp_path / name).write_text(token + "\n")
        (tmp_path / name).chmod(0o600)

    async def body(served: Served, begun: list[str], _: Job) -> None:
        (tmp_path / "inbox").mkdir()
        at = ("--at", f"tcp://127.0.0.1:{served.server.tcp_port}", "--token-file") if tcp else ()
        with Cable() as cable, started("serve", ".", "-p", cable.names[0], *FAST, folder=tmp_path):
            words = ("--folder", "inbox", "--start", "-p", cable.names[1], *FAST, *at)
            right = ("right",) if tcp else ()
            assert await command("receive", "PART", *words, *right, folder=tmp_path) == (0, "")
            assert begun == ["PART.nc"]
            assert (tmp_path / "jobs" / "PART.nc").read_bytes() == PROGRAM
            came = "{}.nc: 60 lines are in inbox, but not printed: {}\n"
            for file, token, why in (
                ("pArt", right, "the machine is busy"),
                *((("paRt", ("weak",), "job.upload needs the scope operate"),) if tcp else ()),
                *((("parT", ("wrong",), "the token is not known here"),) if tcp else ()),
            ):
                status, err = await command("receive", file, *words, *token, folder=tmp_path)
                assert status == 1
                assert err.startswith("canductor: " + came.format(file, why).rstrip())
                assert err.count("\n") == 1
                assert (tmp_path / "inbox" / f"{file}.nc").read_bytes() == PROGRAM

    run_with_machine(tmp_path, body, **({"tcp": plain_tcp(tmp_path)} if tcp else {}))


@pytest.mark.parametrize("bad", [False, True])
def test_drip_to_the_machine(tmp_path: Path, bad: bool) -> None:
    lines = ["%", "G1 X1", "", "G99" if bad else "G1 X2", *(f"G1 X{i}" for i in range(100))]
    (tmp_path / "job.nc").write_text("\n".join(lines) + "\n")
    (tmp_path / "token").write_text(TOKENS[Scope.OPERATE])
    (tmp_path / "token").chmod(0o600)

    async def body(served: Served, _: list[str], job: Job) -> None:
        at = ("--at", f"tcp://127.0.0.1:{served.server.tcp_port}", "--token-file", "token")
        with Cable() as cable, started("serve", ".", "-p", cable.names[0], *FAST, folder=tmp_path):
            words = ("drip", "--from", "JOB", "-p", cable.names[1], *FAST, *at)
            status, err = await command(*words, folder=tmp_path)
        assert job.name == "JOB"
        if bad:
            assert (status, err) == (1, "canductor: JOB:4: G99 is not known\n")
            assert job.lines[:4] == lines[:4]
        else:
            assert (status, err) == (0, "JOB: all 104 lines came; waiting for the machine\n")
            assert job.lines == lines

    run_with_machine(tmp_path, body, tcp=plain_tcp(tmp_path))


class Machine:
    """Answers when it is told to."""

    def __init__(self) -> None:
        self.calls: list[tuple[str, Mapping[str, Any], Future[Any]]] = []

    def begin(self, method: str, params: Mapping[str, Any]) -> Future[Any]:
        answer: Future[Any] = Future()
        self.calls.append((method, params, answer))
        if method == "job.feed" and (not params["text"] or "end" in params or "failure" in params):
            answer.set_result({})
        return answer

    def last(self) -> tuple[int, str]:
        return self.calls[-1][1]["first_line"], self.calls[-1][1]["text"]

    def answer(self) -> None:
        self.calls[-1][2].set_result({})


def test_a_sink_waits_for_the_machine() -> None:
    """While a piece is not answered, some lines wait; then no more may come. None is lost or doubled."""
    machine = Machine()
    sink = MachineSink(machine, "JOB")
    sink.write(b"G1 X0")
    assert machine.last() == (1, "G1 X0\n")
    for number in range(1, LINES_MAX + 1):
        assert sink.ready
        sink.write(b"G1 X%d" % number)
    assert not sink.ready
    assert len(machine.calls) == 3, "nothing is sent before the answer"
    machine.answer()
    assert sink.ready
    assert machine.last() == (2, "".join(f"G1 X{number}\n" for number in range(1, LINES_MAX + 1)))
    sink.write(b"")
    with pytest.raises(FileRefused, match="line 67 of JOB is not ASCII"):
        sink.write(b"\xc4")
    sink.keep()  # goes at once, behind what is not answered
    assert machine.calls[-1][1] == {"name": "JOB", "first_line": 66, "text": "\n", "end": True}
    sink.drop("too late")
    assert "failure" not in machine.calls[-1][1]


def test_a_sink_tells_why_no_more_comes() -> None:
    machine = Machine()
    sink = MachineSink(machine, "JOB")
    sink.write(b"G28")
    sink.write(b"G1 X1")
    sink.drop("the line broke")
    assert machine.calls[-1][1]["failure"] == "the line broke"
    assert machine.last() == (2, "G1 X1\n")


def test_a_job_that_is_cancelled_ends_the_transfer_while_nothing_comes() -> None:
    machine, now_s = Machine(), 0.0
    engine = Engine(DncOptions(answer_s=600.0), now_s, peripheral=True)
    desk = Desk(engine, take=lambda header: MachineSink(machine, header.name))

    def come(data: bytes) -> bytes:
        nonlocal now_s
        now_s += 0.5
        engine.receive(data, now_s)
        now_s += 0.5
        engine.handle_timer(now_s)
        for event in engine.take_events():
            assert desk.handle(event) is None
        return engine.take_output()

    assert come(write_block(SOH, b"DJOBA")) == b"\x06"
    assert come(write_block(STX, b"G28\r\n")) == b"\x06"
    assert desk.looks
    machine.calls[0][2].set_result({"state": "cancelled", "message": ""})
    machine.answer()
    desk.go_on()
    assert engine.take_output() == write_block(SOH, b"NOT PRINTED", dc1=True)
    assert engine.state is State.ERROR_SENT
    engine.receive(b"\x06\x04", now_s + 1)
    engine.handle_timer(now_s + 2)
    (event,) = engine.take_events()
    outcome = desk.handle(event)
    assert outcome is not None
    assert outcome.sentence == "JOB was cancelled at the machine"
