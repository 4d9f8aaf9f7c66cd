"""The emergency stop of every way in reaches the nodes while the control loop is held."""

import asyncio
import json
import os
import signal
import socket
import tempfile
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from coordinator.ipc.client.blocking import BlockingClient
from coordinator.ipc.client.client import Client
from coordinator.ipc.protocol.methods import ApiError, Scope
from tests.stages.held_service import PATIENCE_S, HeldService, serve_held

KLIPPY_STOP = json.dumps({"id": 1, "method": "emergency_stop"}).encode() + b"\x03"
KLIPPY_M112 = json.dumps({"id": 2, "method": "gcode/script", "params": {"script": "M112"}}).encode() + b"\x03"


def stopped_while_held(held: HeldService, stop: Callable[[], object], cause: str) -> None:
    """Check that STOP reaches a node while the loop is held, and that the machine gives CAUSE afterwards."""
    with held.held():
        stop()
        held.wait_for(lambda: not held.fan_turns, f"the node is stopped by {cause}")
    held.wait_for(lambda: cause in held.service.cause, f"the cause is {cause}")
    held.restart()


def every_way(held: HeldService) -> None:
    held.ready()
    with estop(held.socket) as send:
        stopped_while_held(held, send, "canductor (uid")
    with BlockingClient(str(held.socket), name="a pendant") as client:
        stopped_while_held(held, lambda: client.begin("machine.emergency_stop"), "a pendant (uid")
        stopped_while_held(held, lambda: client.begin("gcode.run", {"script": "M112"}), "M112 of a client")
    with socket.socket(socket.AF_UNIX) as new:

        def come() -> None:
            new.connect(str(held.klippy_socket))
            new.sendall(KLIPPY_STOP)

        stopped_while_held(held, come, "a client of the Klippy API")
    with socket.socket(socket.AF_UNIX) as old:
        old.connect(str(held.klippy_socket))
        stopped_while_held(held, lambda: old.sendall(KLIPPY_M112), "M112 of a client of the Klippy API")
    stopped_while_held(held, lambda: os.write(held.terminal, b"M112\n"), "M112 of a client")
    garbage_and_guests(held)
    cut_off(held)


@contextmanager
def estop(path: Path) -> Iterator[Callable[[], None]]:
    """Do what ``canductor estop`` does, with a connection that comes only then."""

    async def call() -> None:
        async with Client.connect(
            str(path), first="machine.emergency_stop", name="canductor", timeout_s=PATIENCE_S
        ) as client:
            assert client.first is not None
            assert (await client.first)["state"] == "shutdown"

    thread = threading.Thread(target=lambda: asyncio.run(call()))
    yield thread.start
    thread.join()


def garbage_and_guests(held: HeldService) -> None:
    """Who may not stop the machine does not stop it while the loop is held, either."""
    with BlockingClient(str(held.socket), name="a guest", scope=Scope.WATCH) as client:
        with held.held():
            begun = client.begin("machine.emergency_stop")
            for path in (held.socket, held.klippy_socket):
                with socket.socket(socket.AF_UNIX) as opened:
                    opened.connect(str(path))
                    opened.sendall(b"\x00\x00\x00\x20machine.emergency_stop{emergency_stop}M112\x03\x03")
        with pytest.raises(ApiError, match="needs the scope operate"):
            begun.result(PATIENCE_S)
    assert held.fan_turns


def cut_off(held: HeldService) -> None:
    """A signal stops a machine that moves."""
    moves = "G1 X20 F3000\nG1 X180\n" * 50
    (held.folder / "long.gcode").write_text(f"G28\n{moves}", encoding="ascii")
    with BlockingClient(str(held.socket)) as client:
        client.call("job.start", {"file": "long.gcode"})
        held.wait_for(lambda: held.service.moves, "it moves")
    with held.held():
        os.kill(os.getpid(), signal.SIGTERM)
        held.wait_for(lambda: not held.fan_turns, "the node is stopped by the signal")
    held.wait_for(lambda: held.service.cut_off, "the cut is noted")


def test_each_way_in_stops_the_nodes_while_the_loop_is_held() -> None:
    with tempfile.TemporaryDirectory() as folder, pytest.raises(KeyboardInterrupt):
        serve_held(Path(folder), every_way)
