"""A received program becomes a job of a machine that runs; a dripped one is a job while it comes."""

import asyncio
import contextlib
from collections.abc import AsyncIterator, Iterator, Mapping
from concurrent.futures import Future
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest

from coordinator.dnc.endpoint import Endpoint
from coordinator.dnc.files import FileRefused
from coordinator.dnc.machine import LINES_MAX, MachineSink
from coordinator.dnc.options import DncOptions
from coordinator.dnc.protocol.blocks import SOH, STX, write_block
from coordinator.dnc.protocol.engine import Engine, State
from coordinator.ipc.protocol.methods import ApiError, Caller, Kind, Method, Param, Scope
from coordinator.ipc.server.uploads import upload_method
from coordinator.support.values import Value
from tests.coordinator.dnc.virtual_cable import PROGRAM, Ended, VirtualCable
from tests.coordinator.ipc.served import TOKENS, Served, plain_tcp, serving
from tests.stages.loop_thread import in_thread
from tests.stages.own_sockets import own_sockets


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


@dataclass
class AtWork:
    """A machine that is served, and what it was asked for."""

    served: Served
    job: Job = field(default_factory=Job)
    begun: list[str] = field(default_factory=list)


@contextlib.contextmanager
def machine(folder: Path, **settings: Any) -> Iterator[AtWork]:
    """Serve, on a thread of its own, an interface with a job folder, and a job that is fed."""
    (folder / "canductor").mkdir(mode=0o700, exist_ok=True)
    (folder / "jobs").mkdir()

    @contextlib.asynccontextmanager
    async def serve() -> AsyncIterator[AtWork]:
        async with serving(folder / "canductor", **settings) as served:
            at_work = AtWork(served)

            def start(_: Caller, params: dict[str, Any]) -> Value:
                if at_work.begun:
                    raise ApiError("busy", "the machine is busy")
                at_work.begun.append(params["file"])
                return {}

            name, text = Param("name", Kind.STR), Param("text", Kind.STR)
            end = Param("end", Kind.BOOL, required=False, default=False)
            failure = Param("failure", Kind.STR, required=False)
            params = (name, Param("first_line", Kind.INT), text, end, failure)
            registry = served.server._context.registry
            registry.add(upload_method(folder / "jobs"))
            registry.add(Method("job.start", Scope.OPERATE, "", start, (Param("file", Kind.STR),)))
            registry.add(Method("job.stream", Scope.OPERATE, "", at_work.job.stream, (name,)))
            registry.add(Method("job.feed", Scope.OPERATE, "", at_work.job.feed, params))
            yield at_work

    with in_thread(serve) as at_work:
        yield at_work


def token_file(path: Path, token: str) -> str:
    path.write_text(token + "\n")
    path.chmod(0o600)
    return str(path)


@pytest.mark.parametrize("tcp", [False, True])
def test_receive_and_start(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, tcp: bool) -> None:
    """Over a Unix socket, and over TCP with a token; when it cannot be started, it is there all the same."""
    own_sockets(monkeypatch, tmp_path)
    inbox, outbox = tmp_path / "inbox", tmp_path / "outbox"
    inbox.mkdir()
    outbox.mkdir()
    (outbox / "part.nc").write_bytes(PROGRAM)
    cable = VirtualCable()
    with (
        machine(tmp_path, **({"tcp": plain_tcp(tmp_path)} if tcp else {})) as at_work,
        cable.started("serve", str(outbox), "-p", "0"),
    ):

        def fetch(name: str, token: str) -> Ended:
            words = ["receive", name, "--folder", str(inbox), "--start", "-p", "1"]
            if tcp:
                words += ["--at", f"tcp://127.0.0.1:{at_work.served.server.tcp_port}"]
                words += ["--token-file", token_file(tmp_path / "token", token)]
            return cable.run(*words)

        right = TOKENS[Scope.OPERATE]
        assert fetch("PART", right).status == 0
        assert at_work.begun == ["PART.nc"]
        assert (tmp_path / "jobs" / "PART.nc").read_bytes() == PROGRAM
        refusals = [("pArt", right, "the machine is busy")]
        if tcp:
            refusals.append(("paRt", TOKENS[Scope.WATCH], "job.upload needs the scope operate"))
            refusals.append(("parT", "x" * 40, "the token is not known here"))
        for file, token, why in refusals:
            ended = fetch(file, token)
            assert ended.status == 1
            came = f"{file}.nc: 60 lines are in {inbox}, but not printed: {why}"
            assert ended.sentences[-1].startswith(came)
            assert (inbox / f"{file}.nc").read_bytes() == PROGRAM


@pytest.mark.parametrize("bad", [False, True])
def test_drip_to_the_machine(tmp_path: Path, bad: bool) -> None:
    lines = ["%", "G1 X1", "", "G99" if bad else "G1 X2", *(f"G1 X{i}" for i in range(100))]
    (tmp_path / "job.nc").write_text("\n".join(lines) + "\n")
    token = token_file(tmp_path / "token", TOKENS[Scope.OPERATE])
    patient = ("--answer-timeout", "86400")  # the machine is outside of virtual time
    cable = VirtualCable()
    with (
        machine(tmp_path, tcp=plain_tcp(tmp_path)) as at_work,
        cable.started("serve", str(tmp_path), "-p", "0", *patient),
    ):
        at = ("--at", f"tcp://127.0.0.1:{at_work.served.server.tcp_port}", "--token-file", token)
        ended = cable.run("drip", "--from", "JOB", "-p", "1", *patient, *at)
    job = at_work.job
    assert job.name == "JOB"
    if bad:
        assert (ended.status, ended.sentences) == (1, ["JOB:4: G99 is not known"])
        assert job.lines[:4] == lines[:4]
    else:
        assert (ended.status, ended.sentences) == (
            0,
            ["JOB: all 104 lines were received; waiting for the machine"],
        )
        assert job.lines == lines


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
    endpoint = Endpoint(engine, take=lambda header: MachineSink(machine, header.name))

    def come(data: bytes) -> bytes:
        nonlocal now_s
        now_s += 0.5
        engine.receive(data, now_s)
        now_s += 0.5
        engine.handle_timer(now_s)
        for event in engine.take_events():
            assert endpoint.handle(event) is None
        return engine.take_output()

    assert come(write_block(SOH, b"DJOBA")) == b"\x06"
    assert come(write_block(STX, b"G28\r\n")) == b"\x06"
    assert endpoint.needs_polling
    machine.calls[0][2].set_result({"state": "cancelled", "message": ""})
    machine.answer()
    endpoint.go_on()
    assert engine.take_output() == write_block(SOH, b"NOT PRINTED", dc1=True)
    assert engine.state is State.ERROR_SENT
    engine.receive(b"\x06\x04", now_s + 1)
    engine.handle_timer(now_s + 2)
    (event,) = engine.take_events()
    outcome = endpoint.handle(event)
    assert outcome is not None
    assert outcome.sentence == "JOB was cancelled at the machine"
