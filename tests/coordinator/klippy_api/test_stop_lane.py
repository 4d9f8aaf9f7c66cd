"""Stops of the Klippy API's clients and of the terminal that wait unread while the test holds the loop."""

import asyncio
import contextlib
import json
import os
import pty
import socket
import sys
from collections.abc import Callable
from pathlib import Path
from typing import NoReturn

import pytest

from coordinator.ipc.protocol.methods import Caller, Method, Registry, Scope
from coordinator.ipc.server.server import IpcServer
from coordinator.ipc.server.settings import IpcSettings
from coordinator.ipc.server.state import StateTree
from coordinator.ipc.server.stop_lane import StopLane
from coordinator.klippy_api.gateway import Gateway
from coordinator.runtime.linux_host import LinuxHost
from coordinator.service.api.motion import motion_methods
from coordinator.service.core.machine_service import MachineService, ServiceSettings
from coordinator.service.core.typed import Typed
from tests.coordinator.ipc.server.test_stop_lane import Hog
from tests.stages.jump_loop import run

WHO = "a client of the Klippy API"


def _load() -> NoReturn:
    raise AssertionError("the service is not run")


class Service(MachineService):
    """Notes who stops it; it is not run."""

    def __init__(self) -> None:
        settings = ServiceSettings(name="test")
        super().__init__(_load, LinuxHost(), StateTree(), settings, on_line=lambda _entry: None)
        self.stops: list[str] = []

    def emergency_stop(self, who: str) -> None:
        self.stops.append(who)
        super().emergency_stop(who)

    async def stops_once(self, find_stop: Callable[[], str | None]) -> None:
        """Let the loop go on until it is stopped: FIND_STOP has to find it until then, and no longer."""
        self.stops.clear()
        while not self.stops:
            assert find_stop() is not None
            await asyncio.sleep(0)
        assert find_stop() is None


def call(method: str, **params: str) -> bytes:
    return json.dumps({"id": 1, "method": method, "params": params}).encode() + b"\x03"


def test_old_and_new_clients_stop_the_machine(tmp_path: Path) -> None:
    path = tmp_path / "klippy.sock"

    async def main() -> None:
        stops: list[str] = []
        lane = StopLane(stops.append)
        service = Service()
        gateway = Gateway(service, Path("printer.cfg"), on_notice=lambda _text: None, stop_lane=lane)
        await gateway.start(path)
        reader, writer = await asyncio.open_unix_connection(path)
        writer.write(call("info"))
        await reader.readuntil(b"\x03")
        writer.write(call("emergency_stop")[:9])
        await asyncio.sleep(0.1)
        lane.look()
        assert stops == []
        writer.write(call("emergency_stop")[9:])
        lane.look()
        assert stops == [WHO]
        await service.stops_once(lane.find)
        await reader.readuntil(b"\x03")
        writer.write(call("gcode/script", script="G28\n m112 ; now"))
        lane.look()
        assert stops == [WHO, f"M112 of {WHO}"]
        await service.stops_once(lane.find)
        await reader.readuntil(b"\x03")
        writer.write(call("gcode/script", script="M117 emergency_stop M112") + b'{"emergency_stop":\x03')
        lane.look()
        assert len(stops) == 2, "neither is a stop"
        await reader.readuntil(b"\x03")
        with contextlib.closing(socket.socket(socket.AF_UNIX)) as new:
            new.connect(str(path))
            new.sendall(call("emergency_stop"))
            lane.look()
            assert stops[2:] == [WHO]
            await service.stops_once(lane.find)
            new.setblocking(False)
            answer = await asyncio.get_running_loop().sock_recv(new, 1000)
            assert json.loads(answer[:-1])["result"] == {}, "the loop serves it later"
        writer.close()
        await gateway.close()

    run(main())


def test_a_client_that_leaves_before_its_turn_has_stopped_the_machine(tmp_path: Path) -> None:
    """While others keep it waiting, the end of its connection is not read."""
    path = tmp_path / "klippy.sock"

    async def main() -> None:
        lane, service = StopLane(), Service()
        gateway = Gateway(service, Path("printer.cfg"), on_notice=lambda _text: None, stop_lane=lane)
        await gateway.start(path)
        for sent in (call("emergency_stop"), call("gcode/script", script="M112")):
            reader, writer = await asyncio.open_unix_connection(path)
            writer.write(call("info"))
            await reader.readuntil(b"\x03")
            service.stops.clear()
            hogs = [Hog(gateway._scheduler) for _ in range(10)]
            for hog in hogs:
                gateway._scheduler.request_turn(hog)
            writer.write(call("info") + sent)
            writer.close()
            while any(hog.rounds for hog in hogs) or gateway._connections:  # noqa: ASYNC110 (no event)
                await asyncio.sleep(0)
            assert len(service.stops) == 1
        await gateway.close()

    run(main())


def test_lines_of_a_client_stop_the_machine() -> None:
    (run_lines,) = [method for method in motion_methods(Service()) if method.name == "gcode.run"]
    caller = Caller("a test", Scope.OPERATE)
    assert run_lines.stops(caller, {"script": "G28\nn1 m112"}) == "M112 of a client"
    for script in ("", "M117 M112", "M1120", "G28 X("):
        assert run_lines.stops(caller, {"script": script}) is None


def test_a_line_of_a_client_is_unread_until_it_is_done(tmp_path: Path) -> None:
    """Failed before: it was in neither place from the turn in which its task was made to the next."""
    path = tmp_path / "api.sock"

    async def main() -> None:
        lane, service, registry = StopLane(), Service(), Registry()
        for method in motion_methods(service):
            registry.add(method)
        server = IpcServer(registry, StateTree(), IpcSettings(unix_path=path), stop_lane=lane)
        await server.start()
        _, writer = await asyncio.open_unix_connection(path)
        for name, params in (("api.hello", {"version": 1}), ("gcode.run", {"script": "G28\nM112"})):
            writer.write(json.dumps({"id": 1, "method": name, "params": params}).encode() + b"\n")
        while lane.find() is None:  # noqa: ASYNC110 (there is no event for it)
            await asyncio.sleep(0)
        await service.stops_once(lane.find)
        writer.close()
        await server.close()

    run(main())


def test_a_line_of_a_client_does_not_wait_for_its_requests(tmp_path: Path) -> None:
    """Failed before: 64 that ran kept it waiting, and meanwhile it kept everybody from a restart."""
    path = tmp_path / "api.sock"

    async def wait(_: Caller, __: object) -> None:
        await asyncio.get_running_loop().create_future()

    async def main() -> None:
        lane, service, registry = StopLane(), Service(), Registry()
        for method in motion_methods(service):
            registry.add(method)
        registry.add(Method("wait", Scope.WATCH, "Wait for ever.", wait))
        server = IpcServer(registry, StateTree(), IpcSettings(unix_path=path), stop_lane=lane)
        await server.start()
        reader, writer = await asyncio.open_unix_connection(path)
        calls: list[tuple[str, dict[str, object]]] = [("api.hello", {"version": 1})]
        calls += [("wait", {})] * (server.limits.running_requests + server.limits.pending_requests)
        for number, (name, params) in enumerate(calls):
            writer.write(json.dumps({"id": number, "method": name, "params": params}).encode() + b"\n")
        await reader.readline()
        for request_id, ignored in (
            (len(calls), None),
            (1, "the id 1 is that of a request without answer yet"),
        ):
            line = {"id": request_id, "method": "gcode.run", "params": {"script": "M117 now\nM112"}}
            writer.write(json.dumps(line).encode() + b"\n")
            answer = json.loads(await reader.readline())
            assert answer["id"] == request_id
            assert answer["result"].get("ignored") == ignored
            assert service.stops == ["M112 of a client"]
            assert lane.find() is None
            service.stops.clear()
        writer.close()
        await server.close()

    run(main())


def test_a_line_typed_at_the_terminal_stops_the_machine(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    user, terminal = pty.openpty()

    async def main() -> None:
        said: list[str] = []
        service = Service()
        typed = Typed(service, said.append)
        assert typed.find_stop() is None
        os.write(user, b"M114\nM1")
        assert typed.find_stop() is None
        os.write(user, b"12 ; stop\n")
        assert typed.find_stop() == "M112 of a client"
        await service.stops_once(typed.find_stop)
        os.write(user, b"M114\n")
        while not said:  # noqa: ASYNC110 (there is no event for it)
            await asyncio.sleep(0)
        assert len(said) == 1, "lines before M112 are left out, those behind it are not"
        assert service.stops == ["M112 of a client"]
        os.write(user, b"\n" * 1500 + b"M112\n")
        assert typed.find_stop() == "M112 of a client", "in one look, though a terminal gives line by line"
        await service.stops_once(typed.find_stop)
        os.write(user, b"M114\n" * 700)
        typed.find_stop()
        os.write(user, b"M114\n" * 700)
        assert len(said) == 1
        while len(said) < 1401:  # noqa: ASYNC110 (there is no event for it)
            await asyncio.sleep(0)
        os.write(user, b"\x04M112\n")
        assert typed.find_stop() is None, "nothing comes behind the end of the input"
        await asyncio.sleep(0.1)
        assert service.stops == ["M112 of a client"]
        typed.close()

    with os.fdopen(terminal) as stdin, contextlib.closing(os.fdopen(user, "rb", buffering=0)):
        monkeypatch.setattr(sys, "stdin", stdin)
        run(main())


def test_a_line_in_the_middle_of_what_a_pipe_brings_stops_the_machine(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A terminal makes line feeds of carriage returns, a pipe does not."""
    far, near = os.pipe()

    async def main() -> None:
        said: list[str] = []
        service = Service()
        typed = Typed(service, said.append)
        os.write(near, b"M114\rM112\nM114\n")
        await asyncio.sleep(0.1)
        assert service.stops == ["M112 of a client"]
        assert len(said) == 1
        typed.close()

    with os.fdopen(far) as stdin, contextlib.closing(os.fdopen(near, "wb", buffering=0)):
        monkeypatch.setattr(sys, "stdin", stdin)
        run(main())
