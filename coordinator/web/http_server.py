"""The HTTP server of the live page and of the metrics: aiohttp, bounded in connections, bytes and time.

What a client sends waits here. In each round of the loop few connections hand a bounded part of it to
aiohttp: one whole request (request_reader.py), and the next one when that was answered.
"""

import asyncio
import functools
import logging
from collections.abc import Awaitable, Callable, Mapping
from typing import Final

from aiohttp import web

from coordinator.ipc.server.stop_lane import StopLane
from coordinator.ipc.server.tcp_listener import TcpListener
from coordinator.ipc.server.tls_transport import TlsServer
from coordinator.web.request_reader import HttpRefusal, RequestReader
from coordinator.web.round_robin import RoundRobin
from coordinator.web.websocket_frames import FrameIntake

SHUTDOWN_S: Final = 1.0
"""For requests that are being answered when the port is closed."""
UNANSWERED_MAX: Final = 16_384
"""Bytes of a request that are kept until it is answered, for the stop lane."""

HEADERS: Final = {"Server": "canductor", "X-Content-Type-Options": "nosniff"}
"""Of each answer; who asks need not know which libraries are at work."""

FindStop = Callable[[str, bytes], str | None]
"""Gets an address, and what came from there and was not answered; returns who stops the machine with it, None
if nobody does. In any thread."""


def _nobody(_: str, _unread: bytes) -> None:
    return None


class HttpServer:
    """Answers the requests at one port with ANSWER; each answer has HEADERS. Lives on the running loop.

    There are CONNECTIONS_MAX connections at most, each for CONNECTION_S unless it is kept (``keep``).
    STOP_LANE finds stops in requests while the loop is held, by FIND_STOP.
    """

    def __init__(
        self,
        answer: Callable[[web.BaseRequest], Awaitable[web.StreamResponse]],
        *,
        connections_max: int,
        connection_s: float,
        headers: Mapping[str, str] = HEADERS,
        tls: TlsServer | None = None,
        stop_lane: StopLane | None = None,
        find_stop: FindStop = _nobody,
    ) -> None:
        self._answer = answer
        self._stop_lane = stop_lane or StopLane()
        self._find_stop = find_stop
        self._connections_max = connections_max
        self._connection_s = connection_s
        self._headers = headers
        self._turns = RoundRobin()
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
        """Connections beyond the most, and requests that were not even parsed."""
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
        handler, goes_on = request.protocol, False
        try:
            answer = await self._answer_or_report(request)
            for name, value in self._headers.items():
                answer.headers.setdefault(name, value)
            if "Upgrade" in request.headers:
                answer.force_close()  # what comes behind it is no request
            goes_on = answer.keep_alive is not False
        finally:
            handler.note_answer(goes_on=goes_on)
        return answer

    async def _answer_or_report(self, request: web.BaseRequest) -> web.StreamResponse:
        try:
            return await self._answer(request)
        except ConnectionError:  # the client has left
            raise
        except Exception as error:  # noqa: BLE001 (a bug must not end the machine; it is reported)
            sentence = f"the answer to {request.method} {request.path!r} failed by a mistake of the program"
            asyncio.get_running_loop().call_exception_handler(
                {"message": f"canductor: {sentence}", "exception": error}
            )
            answer = web.Response(status=500, text="a mistake of the program; please report it\n")
            answer.force_close()
            return answer

    @staticmethod
    def keep(request: web.BaseRequest, frames: FrameIntake) -> Callable[[], bytes]:
        """Let the connection of REQUEST stay: it is a WebSocket now, and FRAMES lets through what comes.

        Returns what returns, in any thread, what has come and was not let through.
        """
        assert isinstance(request.protocol, _Handler)
        request.protocol.keep(frames)
        return request.protocol.waiting

    @staticmethod
    def go_on(request: web.BaseRequest) -> None:
        """Let more frames of the kept connection of REQUEST through, once none of their messages waits."""
        assert isinstance(request.protocol, _Handler)
        request.protocol.go_on()

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
            self._count_refusal,
            turns=self._turns,
            headers=self._headers,
            lane=self._stop_lane,
            find_stop=self._find_stop,
        )

    def _count_refusal(self) -> None:
        self.refused += 1

    def _count_timeout(self) -> None:
        self.timed_out += 1


class _Handler(web.RequestHandler, asyncio.BufferedProtocol):
    """A connection that ends after LIMIT_S; ON_TIMEOUT is called then. LANE looks at it by FIND_STOP.

    It reads nothing from when something has come until its turn, and while a request has no answer and
    something waits behind it.
    """

    def __init__(
        self,
        server: web.Server,
        logger: logging.Logger,
        limit_s: float,
        on_timeout: Callable[[], None],
        on_refusal: Callable[[], None],
        *,
        turns: RoundRobin,
        headers: Mapping[str, str],
        lane: StopLane,
        find_stop: FindStop,
    ) -> None:
        loop = asyncio.get_running_loop()
        super().__init__(server, loop=loop, logger=logger)
        self._limit_s = limit_s
        self._limit: asyncio.TimerHandle | None = None
        self._on_timeout = on_timeout
        self._on_refusal = on_refusal
        self._lane = lane
        self._find_stop = find_stop
        self._turns = turns
        self._headers = headers
        self._reader = RequestReader()
        self._answering = False
        """Whether aiohttp has a request without an answer."""
        self._unanswered = b""
        """What came since the last answer: half a request may have been read when the loop is held."""
        self._frames: FrameIntake | None = None
        """Of a WebSocket; None: requests come."""

    def keep(self, frames: FrameIntake) -> None:
        """Lift the limit of time; no further requests come, but FRAMES."""
        self._release()
        self._frames = frames
        self.go_on()

    def go_on(self) -> None:
        """Hand over what waits, in turns."""
        self._turns.request_turn(self)

    def waiting(self) -> bytes:
        """Return what has come and waits for its turn; in any thread."""
        return bytes(self._reader.waiting)

    def _release(self) -> None:
        if self._limit is not None:
            self._limit.cancel()
        self._lane.forget(self)
        self._unanswered = b""

    def note_answer(self, *, goes_on: bool) -> None:
        """Note that a request was carried out: the stop lane must not do it again.

        If the connection GOES_ON, a request that came behind it gets its turn.
        """
        if not goes_on:
            self._unanswered = b""
            self._reader.waiting.clear()
            return
        self._unanswered = bytes(self._reader.waiting[:UNANSWERED_MAX])
        self._answering = False
        self._turns.request_turn(self)

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        super().connection_made(transport)
        address = str((transport.get_extra_info("peername") or ("unknown",))[0])
        self._lane.watch_transport(self, transport, functools.partial(self._find, address))
        self._limit = asyncio.get_running_loop().call_later(self._limit_s, self._end)

    def _find(self, address: str, unread: bytes) -> str | None:
        return self._find_stop(address, self._unanswered + unread[:UNANSWERED_MAX])

    def get_buffer(self, sizehint: int) -> memoryview:
        """Return the shared buffer to receive into, which bounds what comes at a time."""
        del sizehint
        return self._turns.received

    def buffer_updated(self, nbytes: int) -> None:
        """Keep what was received for a turn."""
        data = bytes(self._turns.received[:nbytes])
        self._reader.waiting += data
        if self._frames is None:
            self._unanswered = (self._unanswered + data)[:UNANSWERED_MAX]
        if self.transport is not None:
            self.transport.pause_reading()
        self._turns.request_turn(self)

    def take_turn(self) -> bool:
        """Hand a bounded part of what waits to aiohttp; return whether there is more for another turn."""
        if self.transport is None or self._is_busy:
            return False  # the next turn is requested by ``note_answer``, or ``go_on``
        self.transport.resume_reading()  # before aiohttp gets something: it may pause, too
        data = self._next_request() if self._frames is None else self._frames.take(self._reader.waiting)
        if not data:
            return False  # more has to come
        super().data_received(data)
        must_wait = bool(self._reader.waiting)
        if must_wait and self.transport is not None:
            self.transport.pause_reading()
        return must_wait and not self._is_busy

    @property
    def _is_busy(self) -> bool:
        return self._answering if self._frames is None else self._frames.is_busy

    def _next_request(self) -> bytes:
        request = self._reader.next_request()
        if isinstance(request, HttpRefusal):
            self._refuse(request)
            return b""
        self._answering = request is not None
        return request or b""

    def _refuse(self, refusal: HttpRefusal) -> None:
        """Answer and close; aiohttp gets nothing of it."""
        body = f"{refusal.sentence}\n".encode()
        own = {"Content-Type": "text/plain; charset=utf-8", "Content-Length": str(len(body))}
        headers = {**self._headers, **own, "Connection": "close"}
        lines = [f"HTTP/1.1 {refusal.status.value} {refusal.status.phrase}"]
        lines += [f"{name}: {value}" for name, value in headers.items()]
        assert self.transport is not None
        self.transport.write("\r\n".join([*lines, "", ""]).encode() + body)
        self._unanswered = b""
        self._reader.waiting.clear()
        self._on_refusal()
        self.force_close()

    def handle_error(
        self,
        request: web.BaseRequest,
        status: int = 500,
        exc: BaseException | None = None,
        message: str | None = None,
    ) -> web.StreamResponse:
        """Return the answer to what aiohttp cannot parse; its own would name aiohttp and have no HEADERS."""
        del request, exc, message
        answer = web.Response(status=status, text="this is no HTTP request\n", headers=self._headers)
        answer.force_close()
        return answer

    def connection_lost(self, exc: BaseException | None) -> None:
        """End; a request that waits for its turn is carried out before, as it may be a stop."""
        self._turns.remove(self)
        request = None if self._answering else self._reader.next_request()
        if isinstance(request, bytes):
            self._answering = True
            super().data_received(request)
        if not self._unanswered:
            self._release()
        self._loop.call_soon(super().connection_lost, exc)  # behind the task that takes a request

    async def start(self) -> None:
        """Answer the requests; those that have come are carried out when the client has left, too."""
        try:
            await super().start()
        finally:
            self._release()

    def _end(self) -> None:
        if self.transport is not None:
            self._on_timeout()
            self.transport.abort()
