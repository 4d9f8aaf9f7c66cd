"""A real pseudo-terminal, before there is any machine; nothing here waits for a certain time."""

import asyncio
import os
import stat
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from itertools import pairwise
from pathlib import Path
from typing import NoReturn

import pytest

from coordinator.ipc.server.state import StateTree
from coordinator.ipc.server.stop_lane import StopLane
from coordinator.runtime.linux_host import LinuxHost
from coordinator.serial_host.host import LINES_AT_ONCE, WHO
from coordinator.serial_host.protocol import OUTPUT_BYTES_MAX
from coordinator.serial_host.terminal import PseudoTerminal
from coordinator.service.core.machine_service import MachineService, ServiceSettings
from nodes.support.errors import CanductorError

LIMIT_S = 60.0
"""Only for what does not come at all."""


def _load() -> NoReturn:
    raise AssertionError("the service is not run")


def _terminal(path: Path) -> PseudoTerminal:
    settings = ServiceSettings(name="test")
    service = MachineService(_load, LinuxHost(), StateTree(), settings, on_line=lambda _entry: None)
    return PseudoTerminal(service, path)


class Port:
    """The host's end of the terminal."""

    def __init__(self, path: Path) -> None:
        self._fd = os.open(path, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
        self.received = b""

    def send(self, data: bytes) -> None:
        assert os.write(self._fd, data) == len(data)

    async def until(self, true: Callable[[], bool]) -> None:
        """Read until TRUE."""
        async with asyncio.timeout(LIMIT_S):
            while not true():
                try:
                    self.received += os.read(self._fd, 4096)
                except BlockingIOError:
                    await asyncio.sleep(0.001)

    def close(self) -> None:
        os.close(self._fd)


@asynccontextmanager
async def opened(path: Path) -> AsyncIterator[tuple[PseudoTerminal, Port]]:
    terminal = _terminal(path)
    terminal.start()
    port = Port(path)
    try:
        yield terminal, port
    finally:
        port.close()
        await terminal.close()


def test_a_stale_link_is_replaced_and_ours_removed(tmp_path: Path) -> None:
    path = tmp_path / "comms" / "printer"

    async def main() -> None:
        path.parent.mkdir()
        path.symlink_to("/dev/pts/from-before")
        async with opened(path) as (_, port):
            assert stat.S_IMODE(path.stat().st_mode) == 0o600
            assert [each.name for each in path.parent.iterdir()] == ["printer"]
            port.send(b"N0 M110 N0*125\nN1 M115*39\nM105\n")
            await port.until(lambda: port.received.endswith(b"\nok T:0\n"))
            assert port.received.startswith(b"ok\nok FIRMWARE_NAME:canductor ")
        assert not path.is_symlink()
        async with opened(path):
            path.unlink()
            path.symlink_to("/of/another")
        assert path.is_symlink(), "another service has it now"
        path.unlink()
        path.write_text("precious", encoding="ascii")
        with pytest.raises(CanductorError, match="exists and is not a link; choose another"):
            _terminal(path).start()
        assert path.read_text(encoding="ascii") == "precious"

    asyncio.run(main())


def test_a_stop_is_found_while_the_loop_is_held(tmp_path: Path) -> None:
    stops: list[str] = []

    async def main() -> None:
        lane = StopLane(stops.append)
        async with opened(tmp_path / "printer") as (terminal, port):
            lane.look_also(terminal.find_stop)
            port.send(b"M115\nM1")
            await port.until(lambda: port.received.endswith(b"\n"))
            lane.look()
            assert stops == []
            port.send(b"12\n")
            while not stops:  # the kernel hands it over when it can; the loop is held by this
                lane.look()
            assert set(stops) == {WHO}
            await port.until(lambda: port.received.endswith(b"\nok\n"))
            stops.clear()
            lane.look()
            assert stops == [], "the loop has it"
        lane.look()

    asyncio.run(main())


def test_lines_that_wait_for_nothing_do_not_hold_the_loop(tmp_path: Path) -> None:
    async def main() -> None:
        async with opened(tmp_path / "printer") as (terminal, _):
            terminal.host.receive(b"\n; note\nM110\n" * 100)
            waiting = [300]
            while waiting[-1]:
                await asyncio.sleep(0)
                waiting.append(len(terminal.host.protocol._waiting))
            assert max(before - after for before, after in pairwise(waiting)) == LINES_AT_ONCE

    asyncio.run(main())


def test_a_host_that_does_not_read_loses_output_alone(tmp_path: Path) -> None:
    async def main() -> None:
        async with opened(tmp_path / "printer") as (terminal, port):
            for number in range(3 * OUTPUT_BYTES_MAX // 16):
                terminal.host.note({"text": f"echo {number:10d}", "output": "plain"})
            port.send(b"M105\n")
            await port.until(lambda: port.received.endswith(b"ok T:0\n"))
            *echoes, _ = port.received.decode().splitlines()
            assert {len(line) for line in echoes} == {15}, "whole lines"
            numbers = [int(line.split()[1]) for line in echoes]
            assert numbers == list(range(numbers[0], 3 * OUTPUT_BYTES_MAX // 16)), "the newest, without a gap"
            assert len(port.received) <= OUTPUT_BYTES_MAX + 8192

    asyncio.run(main())
