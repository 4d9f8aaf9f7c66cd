"""The HTTP server of the live page and of the metrics: aiohttp, bounded in connections, bytes and time."""

import asyncio
import logging
import ssl
from collections.abc import Awaitable, Callable
from typing import Final

from aiohttp import web

from coordinator.ipc.server.tcp_listener import TcpListener

SHUTDOWN_S: Final = 1.0
"""For requests that are being answered when the port is closed."""


class HttpServer:
    """Answers the requests at one port with ANSWER.

    There are CONNECTIONS_MAX connections at most, each for CONNECTION_S unless it is kept (``keep``).
    """

    def __init__(
        self,
        answer: Callable[[web.BaseRequest], Awaitable[web.StreamResponse]],
        *,
        connections_max: int,
        connection_s: float,
        context: ssl.SSLContext | None = None,
    ) -> None:
        self._connections_max = connections_max
        self._connection_s = connection_s
        self._logger = logging.getLogger("canductor.http")
        self._logger.addHandler(logging.NullHandler())  # what strangers send is no news
        self._logger.propagate = False
        self._aiohttp = web.Server(answer)
        self._listener = TcpListener(self._make_handler, context, may_enter=self._may_enter)
        self.refused = 0
        """Connections beyond the most."""
        self.timed_out = 0
        """Connections that were ended after CONNECTION_S."""

    async def open(self, host: str, port: int) -> None:
        """Listen at HOST, any port if PORT is 0; raises OSError."""
        await self._listener.open(host, port)

    @property
    def port(self) -> int:
        """The port, once open."""
        return self._listener.addresses[0][1]

    async def close(self) -> None:
        """End all connections and close the port."""
        self._listener.close()
        await self._aiohttp.shutdown(timeout=SHUTDOWN_S)

    @staticmethod
    def keep(request: web.BaseRequest) -> None:
        """Let the connection of REQUEST stay beyond its time: it is a WebSocket now."""
        assert isinstance(request.protocol, _Handler)
        request.protocol.keep()

    def _may_enter(self, entering: int) -> bool:
        if len(self._aiohttp.connections) + entering < self._connections_max:
            return True
        self.refused += 1
        return False

    def _make_handler(self) -> "_Handler":
        return _Handler(self._aiohttp, self._logger, self._connection_s, self._count_timeout)

    def _count_timeout(self) -> None:
        self.timed_out += 1


class _Handler(web.RequestHandler):
    """A connection that ends after LIMIT_S; ON_TIMEOUT is called then."""

    def __init__(
        self, server: web.Server, logger: logging.Logger, limit_s: float, on_timeout: Callable[[], None]
    ) -> None:
        loop = asyncio.get_running_loop()
        super().__init__(server, loop=loop, logger=logger)
        self._limit_s = limit_s
        self._limit: asyncio.TimerHandle | None = None
        self._on_timeout = on_timeout

    def keep(self) -> None:
        """Lift the limit of time."""
        if self._limit is not None:
            self._limit.cancel()

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        super().connection_made(transport)
        self._limit = asyncio.get_running_loop().call_later(self._limit_s, self._end)

    def connection_lost(self, exc: BaseException | None) -> None:
        self.keep()
        super().connection_lost(exc)

    def _end(self) -> None:
        if self.transport is not None:
            self._on_timeout()
            self.transport.abort()
