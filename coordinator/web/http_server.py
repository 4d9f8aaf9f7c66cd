"""The HTTP server of the live page and of the metrics: aiohttp, bounded in connections, bytes and time."""

import asyncio
import functools
import logging
from collections.abc import Awaitable, Callable
from typing import Final

from aiohttp import web

from coordinator.ipc.server.stop_lane import StopLane
from coordinator.ipc.server.tcp_listener import TcpListener
from coordinator.ipc.server.tls_transport import TlsServer

SHUTDOWN_S: Final = 1.0
"""For requests that are being answered when the port is closed."""
UNANSWERED_MAX: Final = 16_384
"""Bytes of a request that are kept until it is answered, for the stop lane."""

FindStop = Callable[[str, bytes], str | None]
"""Gets an address, and what came from there and was not answered; returns who stops the machine with it, None
if nobody does. In any thread."""


def _nobody(_: str, _unread: bytes) -> None:
    return None


class HttpServer:
    """Answers the requests at one port with ANSWER.

    There are CONNECTIONS_MAX connections at most, each for CONNECTION_S unless it is kept (``keep``).
    STOP_LANE finds stops in requests while the loop is held, by FIND_STOP.
    """

    def __init__(
        self,
        answer: Callable[[web.BaseRequest], Awaitable[web.StreamResponse]],
        *,
        connections_max: int,
        connection_s: float,
        tls: TlsServer | None = None,
        stop_lane: StopLane | None = None,
        find_stop: FindStop = _nobody,
    ) -> None:
        self._answer = answer
        self._stop_lane = stop_lane or StopLane()
        self._find_stop = find_stop
        self._connections_max = connections_max
        self._connection_s = connection_s
        self._logger = logging.getLogger("canductor.http")
        self._logger.addHandler(logging.NullHandler())  # what strangers send is no news
        self._logger.propagate = False
        self._aiohttp = web.Server(self._answer_once)
        self._listener = TcpListener(
            self._make_handler,
            tls,
            may_enter=self._may_enter,
            stop_lane=self._stop_lane,
            find_stop=find_stop,
        )
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

    async def _answer_once(self, request: web.BaseRequest) -> web.StreamResponse:
        assert isinstance(request.protocol, _Handler)
        try:
            return await self._answer(request)
        finally:
            request.protocol.note_answer()

    @staticmethod
    def hear(request: web.BaseRequest, feed: Callable[[bytes], None]) -> None:
        """Have FEED get what comes on the connection of REQUEST, too, from now on."""
        assert isinstance(request.protocol, _Handler)
        request.protocol.hear(feed)

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
        return _Handler(
            self._aiohttp,
            self._logger,
            self._connection_s,
            self._count_timeout,
            lane=self._stop_lane,
            find_stop=self._find_stop,
        )

    def _count_timeout(self) -> None:
        self.timed_out += 1


class _Handler(web.RequestHandler):
    """A connection that ends after LIMIT_S; ON_TIMEOUT is called then. LANE looks at it by FIND_STOP."""

    def __init__(
        self,
        server: web.Server,
        logger: logging.Logger,
        limit_s: float,
        on_timeout: Callable[[], None],
        *,
        lane: StopLane,
        find_stop: FindStop,
    ) -> None:
        loop = asyncio.get_running_loop()
        super().__init__(server, loop=loop, logger=logger)
        self._limit_s = limit_s
        self._limit: asyncio.TimerHandle | None = None
        self._on_timeout = on_timeout
        self._lane = lane
        self._find_stop = find_stop
        self._unanswered = b""
        """What came since the last answer: half a request may have been read when the loop is held."""
        self._reads_requests = True
        self._feed: Callable[[bytes], None] | None = None

    def hear(self, feed: Callable[[bytes], None]) -> None:
        """Have FEED get what comes, too."""
        self._feed = feed

    def keep(self) -> None:
        """Lift the limit of time; no further requests come."""
        if self._limit is not None:
            self._limit.cancel()
        self._lane.forget(self)
        self._reads_requests, self._unanswered = False, b""

    def note_answer(self) -> None:
        """Note that a request was carried out: the stop lane must not do it again.

        What a client sends behind it without waiting for the answer waits for the loop: no browser does that.
        """
        self._unanswered = b""

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        super().connection_made(transport)
        address = str((transport.get_extra_info("peername") or ("unknown",))[0])
        self._lane.watch_transport(self, transport, functools.partial(self._find, address))
        self._limit = asyncio.get_running_loop().call_later(self._limit_s, self._end)

    def _find(self, address: str, unread: bytes) -> str | None:
        return self._find_stop(address, self._unanswered + unread[:UNANSWERED_MAX])

    def data_received(self, data: bytes) -> None:
        if self._reads_requests:
            self._unanswered = (self._unanswered + data)[:UNANSWERED_MAX]
        if self._feed is not None:
            self._feed(data)
        super().data_received(data)

    def connection_lost(self, exc: BaseException | None) -> None:
        if not self._unanswered:
            self.keep()
        super().connection_lost(exc)

    async def start(self) -> None:
        """Answer the requests; those that have come are carried out when the client has left, too."""
        try:
            await super().start()
        finally:
            self.keep()

    def _end(self) -> None:
        if self.transport is not None:
            self._on_timeout()
            self.transport.abort()
