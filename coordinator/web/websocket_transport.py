"""A WebSocket as the transport of a connection of coordinator.ipc: lines of JSON, text frames on the way.

The connection gets what it gets of a socket: it has to pause when the browser does not read.
"""

import asyncio
from collections import deque
from typing import Any, Final

from aiohttp import web

from coordinator.ipc.server.connection import Connection

LOW_SHARE: Final = 4
"""Sending goes on when a quarter of the limit is left."""


class WebSocketTransport(asyncio.Transport):
    """Sends to SOCKET in ``run``; CONNECTION is called to pause and resume writing."""

    def __init__(self, socket: "web.WebSocketResponse") -> None:
        super().__init__()
        self._socket = socket
        self._chunks: deque[bytes] = deque()
        self._waiting_bytes = 0
        self._high_bytes = 65_536
        self._full = False
        self._closing = False
        self._news = asyncio.Event()
        self._readable = asyncio.Event()
        self._readable.set()
        self.connection: Connection
        """Set before ``run``."""

    async def run(self) -> None:
        """Send what is written until ``close`` and ``abort``."""
        while True:
            await self._news.wait()
            self._news.clear()
            data = b"".join(self._chunks)
            self._chunks.clear()
            if data:
                await self._socket.send_str(data.decode())
                self._sent(len(data))
            if self._closing and not self._chunks:
                await self._socket.close()
                return

    def _sent(self, count: int) -> None:
        self._waiting_bytes -= count
        if self._full and self._waiting_bytes <= self._high_bytes // LOW_SHARE:
            self._full = False
            self.connection.resume_writing()

    async def readable(self) -> None:
        """Wait until the connection takes more."""
        await self._readable.wait()

    # ------------------------------------------------------------------------------- asyncio.Transport

    def set_write_buffer_limits(self, high: int | None = None, low: int | None = None) -> None:
        """Set what may wait before the connection has to."""
        del low
        self._high_bytes = 65_536 if high is None else high

    def get_write_buffer_size(self) -> int:
        """Return how many bytes wait, or are being sent."""
        return self._waiting_bytes

    def write(self, data: Any) -> None:
        """Send DATA, whole lines, when the browser reads."""
        if self._closing:
            return
        self._chunks.append(bytes(data))
        self._waiting_bytes += len(data)
        self._news.set()
        if not self._full and self._waiting_bytes > self._high_bytes:
            self._full = True
            self.connection.pause_writing()

    def can_write_eof(self) -> bool:
        """Return that a WebSocket cannot be half closed."""
        return False

    def is_closing(self) -> bool:
        """Return whether nothing more is taken."""
        return self._closing

    def close(self) -> None:
        """Send what waits, then close."""
        self._closing = True
        self._readable.set()
        self._news.set()

    def abort(self) -> None:
        """Close at once."""
        self._chunks.clear()
        self.close()

    def pause_reading(self) -> None:
        """Stop reading."""
        self._readable.clear()

    def resume_reading(self) -> None:
        """Go on."""
        self._readable.set()
