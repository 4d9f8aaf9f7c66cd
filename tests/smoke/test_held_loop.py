"""An emergency stop reaches the nodes while the control loop is held; each way in has tests of its own."""

import asyncio
import os
import signal
import tempfile
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from coordinator.ipc.client.blocking import BlockingClient
from coordinator.ipc.client.client import Client
from coordinator.ipc.protocol.methods import ApiError
from tests.stages.held_service import PATIENCE_S, HeldService, serve_held


def a_command_and_a_signal(held: HeldService) -> None:
    held.ready()
    with estop(held.socket) as send, held.held():
        send()
        held.wait_for(lambda: not held.fan_turns, "the node is stopped by the command")
    held.wait_for(lambda: "canductor (uid" in held.service.cause, "the cause is there")
    held.restart()
    a_restart_right_behind(held)
    a_line_behind_one_that_waits(held)
    cut_off(held)


def a_restart_right_behind(held: HeldService) -> None:
    """It would be undone (and was) when the loop reads the stop that the lane has carried out."""
    refused: list[str] = []

    def restart() -> None:
        try:
            held.service.restart()
        except ApiError as error:
            refused.append(error.sentence)

    with estop(held.socket) as send, held.held():
        send()
        held.wait_for(lambda: not held.fan_turns, "the node is stopped by the command")
        held.loop.call_soon_threadsafe(restart)
    assert len(refused) == 1
    assert "an emergency stop by 'canductor (uid" in refused[0]
    held.restart()


def a_line_behind_one_that_waits(held: HeldService) -> None:
    """M112 is typed while the line before it is being done; it waited for the end of that."""
    os.write(held.terminal, b"M109 S250\n")
    held.wait_for(lambda: held.service.motion is not None and held.service.motion.feeder.busy, "it heats")
    os.write(held.terminal, b"G28\nM112\n")
    held.wait_for(lambda: not held.fan_turns, "the node is stopped by the line")
    held.restart()


@contextmanager
def estop(path: Path) -> Iterator[Callable[[], None]]:
    """Do what ``canductor estop`` does, with a connection that comes only then."""

    async def call() -> None:
        async with Client(
            str(path), first="machine.emergency_stop", name="canductor", timeout_s=PATIENCE_S
        ) as client:
            assert client.first is not None
            assert (await client.first)["state"] == "shutdown"

    thread = threading.Thread(target=lambda: asyncio.run(call()))
    yield thread.start
    thread.join()


def cut_off(held: HeldService) -> None:
    """A signal stops a machine that moves."""
    lines = "SET_KINEMATIC_POSITION X=100 Y=100 Z=10\n" + "G1 X20 F3000\nG1 X180\n" * 50
    (held.folder / "long.gcode").write_text(lines, encoding="ascii")
    with BlockingClient(str(held.socket)) as client:
        client.call("job.start", {"file": "long.gcode"})
        held.wait_for(lambda: held.service.moves, "it moves")
    with held.held():
        os.kill(os.getpid(), signal.SIGTERM)
        held.wait_for(lambda: not held.fan_turns, "the node is stopped by the signal")
    held.wait_for(lambda: held.service.cut_off, "the cut is noted")


def test_the_nodes_are_stopped_while_the_loop_is_held() -> None:
    with tempfile.TemporaryDirectory() as folder, pytest.raises(KeyboardInterrupt):
        serve_held(Path(folder), a_command_and_a_signal)
