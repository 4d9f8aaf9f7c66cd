"""The interface of a service in virtual time: its real server, with clients whose lines are in memory."""

import asyncio
import json
import struct
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import msgpack

from coordinator.ipc.protocol.methods import ApiError, Scope
from coordinator.ipc.server.server import ExternalGrant, IpcServer
from coordinator.ipc.server.settings import IpcSettings
from tests.stages.served import Served

LIMIT_S = 60.0


class MemoryTransport(asyncio.Transport):
    """What the server writes to; a client that reads at once."""

    def __init__(self) -> None:
        super().__init__()
        self.written = bytearray()
        self.ended = False
        """Whether the server has closed its side."""
        self.news = asyncio.Event()

    def write(self, data: Any) -> None:
        self.written += data
        self.news.set()

    def can_write_eof(self) -> bool:
        return True

    def write_eof(self) -> None:
        self.ended = True
        self.news.set()

    def close(self) -> None:
        self.write_eof()

    def abort(self) -> None:
        self.write_eof()

    def is_closing(self) -> bool:
        return self.ended

    def pause_reading(self) -> None:
        """The connection has all that was sent."""

    def resume_reading(self) -> None:
        """Likewise."""

    def set_write_buffer_limits(self, high: int | None = None, low: int | None = None) -> None:
        """Nothing waits."""


ADDRESS = "127.0.0.1"


def _check_token_by(server: IpcServer) -> Callable[[str], ExternalGrant | None]:
    """Return a check of tokens by the file of SERVER, as TCP clients have it."""

    def check(token: str) -> ExternalGrant | None:
        try:
            return ExternalGrant(server.check_token(token, ADDRESS), None)
        except ApiError:
            return None

    return check


class Line:
    """A client that sends whatever it is asked to, in JSON or msgpack."""

    def __init__(self, server: IpcServer, granted: Scope | None, *, packed: bool) -> None:
        self._packed = packed
        self._transport = MemoryTransport()
        self._connection = server.adopt(self._transport, ADDRESS, _check_token_by(server))
        self._connection.session.granted = granted  # as the Unix socket does for its owner
        self._updates: list[dict[str, Any]] = []

    def encoded(self, message: dict[str, Any]) -> bytes:
        """Return MESSAGE as it goes over a wire."""
        if not self._packed:
            return json.dumps(message).encode() + b"\n"
        body: bytes = msgpack.packb(message)
        return struct.pack(">I", len(body)) + body

    def send(self, message: dict[str, Any]) -> None:
        """Send MESSAGE."""
        self.send_bytes(self.encoded(message))

    def send_bytes(self, data: bytes) -> None:
        """Send DATA, unless the server has closed the line."""
        if not self._transport.ended:
            self._connection.receive(data)

    async def ask(self, method: str, **params: Any) -> dict[str, Any]:
        """Return the answer."""
        self.send({"id": 1, "method": method, "params": params})
        while "id" not in (message := await self.receive()):
            self._updates.append(message)
        return message

    async def outcome(self, method: str, params: dict[str, Any]) -> str:
        """Return "result", or the error's code."""
        answer = await self.ask(method, **params)
        return "result" if "result" in answer else str(answer["error"]["code"])

    async def next_update(self) -> dict[str, Any]:
        """Return the next message that answers nothing."""
        return self._updates.pop(0) if self._updates else await self.receive()

    async def receive(self) -> dict[str, Any]:
        """Return the next message."""
        async with asyncio.timeout(LIMIT_S):
            while (message := self._next()) is None:
                assert not self._transport.ended, "the server ended it"
                await self._wait()
        return message

    async def last_words(self) -> dict[str, Any]:
        """Read to the end that the server makes, and return why."""
        async with asyncio.timeout(LIMIT_S):
            while not self._transport.ended:
                await self._wait()
        message: dict[str, Any] = {}
        while self._transport.written:
            following = self._next()
            assert following is not None, "it ended within a message"
            message = following
        assert message.keys() == {"error"}, message
        return dict(message["error"])

    def leave(self) -> None:
        """Close the line."""
        self._transport.ended = True
        self._connection.connection_lost(None)

    async def _wait(self) -> None:
        self._transport.news.clear()
        await self._transport.news.wait()

    def _next(self) -> dict[str, Any] | None:
        data = self._transport.written
        if self._packed:
            size = 4 + struct.unpack_from(">I", data)[0] if len(data) >= 4 else 1 << 30
            body = bytes(data[4:size])
        else:
            size = data.find(b"\n") + 1 or 1 << 30
            body = bytes(data[:size])
        if len(data) < size:
            return None
        del data[:size]
        return dict(msgpack.unpackb(body) if self._packed else json.loads(body))


class Interface:
    """The server of a service, without sockets."""

    def __init__(self, server: IpcServer) -> None:
        self.server = server

    @classmethod
    @asynccontextmanager
    async def of(cls, served: Served, tokens: Path) -> AsyncIterator["Interface"]:
        """Serve SERVED to clients with TOKENS, a file."""
        server = IpcServer(served.registry, served.tree, IpcSettings(unix_path=None, tokens=tokens))
        await server.start()
        try:
            yield cls(server)
        finally:
            await server.close()

    def connect(self, *, granted: Scope | None, packed: bool = False) -> Line:
        """Connect a client that may do what is GRANTED without a token; None: nothing, as over TCP."""
        return Line(self.server, granted, packed=packed)
