"""Stops of the Klippy API's clients and of the terminal that wait unread while the test holds the loop."""

import asyncio
import contextlib
import json
import os
import pty
import socket
import sys
from pathlib import Path
from typing import NoReturn

import pytest

from coordinator.ipc.protocol.methods import Caller, Scope
from coordinator.ipc.server.state import StateTree
from coordinator.ipc.server.stop_lane import StopLane
from coordinator.klippy_api.gateway import Gateway
from coordinator.runtime.linux_host import LinuxHost
from coordinator.service.api.motion import motion_methods
from coordinator.service.core.machine_service import MachineService, ServiceSettings
from coordinator.service.core.typed import Typed
from tests.stages.jump_loop import run

WHO = "a client of the Klippy API"


def _load() -> NoReturn:
    raise AssertionError("the service is not run")


def _service() -> MachineService:
    settings = ServiceSettings(name="test")
    return MachineService(_load, LinuxHost(), StateTree(), settings, on_line=lambda _entry: None)


def call(method: str, **params: str) -> bytes:
    return json.dumps({"id": 1, "method": method, "params": params}).encode() + b"\x03"


def test_old_and_new_clients_stop_the_machine(tmp_path: Path) -> None:
    path = tmp_path / "klippy.sock"

    async def main() -> None:
        stops: list[str] = []
        lane = StopLane(stops.append)
        service = _service()
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
        await reader.readuntil(b"\x03")
        writer.write(call("gcode/script", script="G28\n m112 ; now"))
        lane.look()
        assert stops == [WHO, f"M112 of {WHO}"]
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
            new.setblocking(False)
            answer = await asyncio.get_running_loop().sock_recv(new, 1000)
            assert json.loads(answer[:-1])["result"] == {}, "the loop serves it later"
        writer.close()
        await gateway.close()

    run(main())


def test_lines_of_a_client_stop_the_machine() -> None:
    (run_lines,) = [method for method in motion_methods(_service()) if method.name == "gcode.run"]
    caller = Caller("a test", Scope.OPERATE)
    assert run_lines.stops(caller, {"script": "G28\nn1 m112"}) == "M112 of a client"
    for script in ("", "M117 M112", "M1120", "G28 X("):
        assert run_lines.stops(caller, {"script": script}) is None


def test_a_line_typed_at_the_terminal_stops_the_machine(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    user, terminal = pty.openpty()

    async def main() -> None:
        said: list[str] = []
        service = _service()
        typed = Typed(service, said.append)
        assert typed.find_stop() is None
        os.write(user, b"M114\nM1")
        assert typed.find_stop() is None
        os.write(user, b"12 ; stop\n")
        assert typed.find_stop() == "M112 of a client"
        await asyncio.sleep(0.1)
        assert len(said) == 1, "the loop has M114, which nothing can answer yet; M112 has no answer"
        assert typed.find_stop() is None
        typed.close()

    with os.fdopen(terminal) as stdin, contextlib.closing(os.fdopen(user, "rb", buffering=0)):
        monkeypatch.setattr(sys, "stdin", stdin)
        run(main())
