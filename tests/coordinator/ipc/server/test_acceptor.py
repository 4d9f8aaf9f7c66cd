"""How connections are let in: some in each round of the loop, however many come."""

import asyncio
import socket
from pathlib import Path

from coordinator.ipc.server.stop_lane import StopLane
from coordinator.ipc.server.unix_socket import UnixListener
from tests.stages import jump_loop

GUESTS = 40
PER_ROUND = 2
"""One whom the loop accepts, and one whom the stop lane's thread has accepted."""


def test_many_who_come_at_once_leave_the_rounds_of_the_loop_short(tmp_path: Path) -> None:
    """Failed before: eight in a round; two programs that connected and left stopped a print."""
    come: list[asyncio.BaseTransport] = []

    class Guest(asyncio.Protocol):
        def connection_made(self, transport: asyncio.BaseTransport) -> None:
            come.append(transport)

    async def main(lane: StopLane, ahead: int) -> None:
        come.clear()
        listener = UnixListener(Guest, lane, lambda _, __: None)
        await listener.open(tmp_path / "socket")
        guests = [socket.socket(socket.AF_UNIX) for _ in range(GUESTS)]
        for number, guest in enumerate(guests):
            guest.connect(str(tmp_path / "socket"))
            if number < ahead:
                lane.handle_events()
        while len(come) < GUESTS:
            before = len(come)
            await asyncio.sleep(0)
            assert len(come) - before <= PER_ROUND
        listener.close()
        for transport in come:
            assert isinstance(transport, asyncio.Transport)
            transport.abort()
        for guest in guests:
            guest.close()

    for ahead in (0, GUESTS // 2, GUESTS):
        jump_loop.run(main(StopLane(), ahead))
