"""Serves a virtual bus to socketcand clients over TCP: every client is one more node on the bus.

The protocol is in ``socketcand``; here are only its sockets. Each TCP client has a connection of its own to
the bus, so that it takes part in the arbitration and meets the bus's faults. A client that sends more than
the bus carries is made to wait. One that does not read is disconnected as soon as CLIENT_BUFFER bytes wait
for it: stopping the bus for it would disturb all others.
"""

import asyncio
import contextlib
import math
import socket
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Self

from canbus_tools.inject.socketcand import SocketcandSession
from nodes.support.errors import CanductorError
from nodes.transport.frame import RECORD_SIZE, CanFrame

PORT: Final = 29536
"""The usual one of socketcand."""
CLIENTS_MAX: Final = 16
CLIENT_BUFFER: Final = 1 << 20
"""Bytes: more than three seconds of a full bus, besides what the kernel keeps."""
READ_SIZE: Final = 4096


@dataclass(slots=True)
class ServerStats:
    """What a server has seen."""

    connected: int = 0
    """Clients now."""
    clients: int = 0
    """Clients in all."""
    errors: int = 0
    """Commands that were refused."""
    slow: int = 0
    """Clients disconnected because they did not read."""
    refused: int = 0
    """Connections beyond CLIENTS_MAX."""


class SocketcandServer:
    """Listens at HOST and PORT (0: any that is free) for clients of the bus at the Unix socket BUS_PATH.

    An asynchronous context manager. NAME is what clients have to open.
    """

    def __init__(self, bus_path: Path, host: str = "127.0.0.1", port: int = PORT, name: str = "can0") -> None:
        """Nothing happens before the context is entered."""
        self.host = host
        self.port = port
        self.name = name
        self.stats = ServerStats()
        self._bus_path = bus_path
        self._server: asyncio.Server | None = None
        self._clients: set[asyncio.Task[None]] = set()

    async def __aenter__(self) -> Self:
        """Begin to listen; raises CanductorError when the address cannot be had."""
        try:
            self._server = await asyncio.start_server(self._accept, self.host, self.port, limit=READ_SIZE)
        except (OSError, UnicodeError) as error:
            raise CanductorError(
                f"socketcand at {self.host}:{self.port}: cannot listen: {error}; choose another address"
                " or port"
            ) from error
        self.port = self._server.sockets[0].getsockname()[1]
        return self

    async def __aexit__(self, *_: object) -> None:
        """Disconnect all."""
        assert self._server is not None
        self._server.close()
        for task in self._clients:
            task.cancel()
        await asyncio.gather(*self._clients, return_exceptions=True)
        await self._server.wait_closed()

    def _accept(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        # Its own task: one made by asyncio would be reported as failed when it is cancelled.
        task = asyncio.get_running_loop().create_task(self._serve_one(reader, writer))
        self._clients.add(task)
        task.add_done_callback(self._clients.discard)

    async def _serve_one(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        with contextlib.suppress(OSError):  # either side may go at any time
            try:
                await self._serve(reader, writer)
            finally:
                writer.close()

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        if self.stats.connected == CLIENTS_MAX:
            self.stats.refused += 1
            writer.write(b"< error this server has all the clients it can have >")
            await writer.drain()
            return
        writer.get_extra_info("socket").setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        bus_reader, bus_writer = await asyncio.open_unix_connection(self._bus_path)
        self.stats.clients += 1
        self.stats.connected += 1
        client = _Client(SocketcandSession((self.name,)), writer, bus_writer)
        try:
            await client.run(reader, bus_reader)
        finally:
            self.stats.connected -= 1
            self.stats.errors += client.session.errors
            bus_writer.close()
            if client.slow:
                self.stats.slow += 1
                writer.transport.abort()  # or what it does not read would be kept


class _Client:
    """One connection at work."""

    def __init__(
        self, session: SocketcandSession, writer: asyncio.StreamWriter, bus_writer: asyncio.StreamWriter
    ) -> None:
        self.session = session
        self.slow = False
        self._writer = writer
        self._bus_writer = bus_writer
        self._wake_s = math.inf
        """When the timer will look again."""
        self._earlier = asyncio.Event()
        """It has to look sooner."""

    async def run(self, reader: asyncio.StreamReader, bus_reader: asyncio.StreamReader) -> None:
        """Serve until either side ends, or the client is too slow."""
        jobs = [
            asyncio.create_task(job)
            for job in (self._from_client(reader), self._from_bus(bus_reader), self._timer())
        ]
        try:
            ended, _ = await asyncio.wait(jobs, return_when=asyncio.FIRST_COMPLETED)
            for job in ended:
                job.result()  # raises what ended it
        finally:
            for job in jobs:
                job.cancel()
            await asyncio.gather(*jobs, return_exceptions=True)

    async def _from_client(self, reader: asyncio.StreamReader) -> None:
        while self._answer() and not self.session.closing:
            data = await reader.read(READ_SIZE)
            if not data:
                return
            self.session.receive(data, time.monotonic())
            await self._to_bus()

    async def _from_bus(self, bus_reader: asyncio.StreamReader) -> None:
        pending = b""
        while data := await bus_reader.read(READ_SIZE):
            pending += data
            now_s, unix_s = time.monotonic(), time.time()
            whole = len(pending) // RECORD_SIZE * RECORD_SIZE
            for at in range(0, whole, RECORD_SIZE):
                frame = CanFrame.from_record(pending[at : at + RECORD_SIZE])
                if frame is not None:
                    self.session.receive_frame(frame, now_s, unix_s)
            pending = pending[whole:]
            if not self._answer():
                return

    async def _timer(self) -> None:
        while self._answer():
            self._earlier.clear()
            self._wake_s = self.session.next_deadline()
            wait_s = max(0.0, self._wake_s - time.monotonic())
            try:
                await asyncio.wait_for(self._earlier.wait(), None if math.isinf(wait_s) else wait_s)
            except TimeoutError:
                self.session.handle_timer(time.monotonic())
                await self._to_bus()

    async def _to_bus(self) -> None:
        frames = self.session.frames_to_send()
        if frames:
            self._bus_writer.write(b"".join(frame.to_record() for frame in frames))
            await self._bus_writer.drain()

    def _answer(self) -> bool:
        """Send what the session has to say; False when the client does not read it."""
        if self.session.next_deadline() < self._wake_s:
            self._earlier.set()
        if output := self.session.output():
            self._writer.write(output)
        self.slow = self._writer.transport.get_write_buffer_size() > CLIENT_BUFFER
        return not self.slow
