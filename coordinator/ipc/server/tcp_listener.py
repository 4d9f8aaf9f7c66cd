"""Listens on a TCP port and bounds what waits there, TLS handshakes included (asyncio).

The servers of asyncio keep any number of clients that never finish their handshake: they cannot count or
refuse them. So connections are accepted here (docs/adr/0013-network-edge.md).
"""

import asyncio
import contextlib
import functools
import resource
import socket
import ssl
from collections import Counter
from collections.abc import Callable
from typing import Final

from coordinator.ipc.server.stop_lane import Arrival, StopLane, find_unread
from coordinator.ipc.server.tls_transport import TlsState, serve_tls

BACKLOG: Final = 128
HANDSHAKES_MAX: Final = 128
"""TLS handshakes at a time; for one more, the oldest of the address that has most of them is closed."""
HANDSHAKE_S: Final = 5.0
ACCEPTS_PER_ROUND: Final = 8
"""Connections taken before the rest of the loop gets its turn."""
RETRY_S: Final = 0.2
"""After the system had no file left for a connection."""
FILES_MAX: Final = 65_536
"""More than all connections and logs of a service need."""


def _always(_: int) -> bool:
    return True


def _nobody(_: str, _unread: bytes) -> None:
    return None


class TcpListener:
    """A TCP port, with TLS where there is a CONTEXT. MAKE_PROTOCOL makes the protocol of each connection.

    MAY_ENTER gets how many connections are being set up, and returns whether there may be one more. With a
    STOP_LANE others may come in while the loop is held; FIND_STOP gets an address, and what came from there.
    """

    def __init__(
        self,
        make_protocol: Callable[[], asyncio.BaseProtocol],
        context: ssl.SSLContext | None,
        *,
        handshakes_max: int = HANDSHAKES_MAX,
        may_enter: Callable[[int], bool] = _always,
        stop_lane: StopLane | None = None,
        find_stop: Callable[[str, bytes], str | None] = _nobody,
    ) -> None:
        self._make_protocol = make_protocol
        self._context = context
        self._handshakes_max = handshakes_max
        self._may_enter = may_enter
        self._stop_lane = stop_lane
        self._find_stop = find_stop
        self._listeners: list[socket.socket] = []
        self._accepting: list[asyncio.Task[None]] = []
        self._entering: dict[asyncio.Task[None], str] = {}
        """Oldest first, with their addresses."""
        self.refused = 0
        """Connections that were closed before or during their handshake, for lack of room."""
        self.starved = 0
        """How often the system had no file left for a connection."""

    async def open(self, host: str, port: int) -> None:
        """Listen at HOST, any port if PORT is 0; raises OSError."""
        loop = asyncio.get_running_loop()
        server = await loop.create_server(asyncio.Protocol, host, port, start_serving=False)
        try:
            for bound in server.sockets:  # asyncio has resolved the addresses
                self._listeners.append(bound.dup())
            for listener in self._listeners:
                listener.setblocking(False)
                listener.listen(BACKLOG)
        except OSError:
            self.close()
            raise
        finally:
            server.close()
        self._accepting = [loop.create_task(self._accept(listener)) for listener in self._listeners]
        if self._stop_lane is not None:
            for listener in self._listeners:
                self._stop_lane.listen_with(listener, loop, functools.partial(self._arrive, loop))

    @property
    def addresses(self) -> list[tuple[str, int]]:
        """The addresses and ports that are open; 0.0.0.0 and :: stand for all addresses."""
        return [listener.getsockname()[:2] for listener in self._listeners]

    @property
    def entering(self) -> int:
        """How many connections are being set up: with TLS, shake hands."""
        return len(self._entering)

    def close(self) -> None:
        """Accept nobody any more, and end the handshakes; connections stay."""
        for task in (*self._accepting, *self._entering):
            task.cancel()
        for listener in self._listeners:
            asyncio.get_running_loop().remove_reader(listener)
            listener.close()
        self._accepting.clear()
        self._listeners.clear()

    async def _accept(self, listener: socket.socket) -> None:
        loop, taken = asyncio.get_running_loop(), 0
        while True:
            try:
                opened, address = await loop.sock_accept(listener)
            except ConnectionAbortedError:  # the client has left already
                continue
            except OSError:  # no file or memory for it: others may free some
                self.starved += 1
                await asyncio.sleep(RETRY_S)
                continue
            self._take(opened, address[0], loop)
            taken += 1
            if taken % ACCEPTS_PER_ROUND == 0:
                await asyncio.sleep(0)  # sock_accept returns without a pause while some wait

    def _arrive(self, loop: asyncio.AbstractEventLoop, opened: socket.socket) -> Arrival:
        """Look for a stop in what OPENED sends, accepted by the stop lane, in its thread."""
        address = _address_of(opened)
        find_stop = functools.partial(self._find_stop, address)
        if self._context is None:
            find = functools.partial(find_unread, opened, find_stop)
            return Arrival(find, lambda: self._take(opened, address, loop), opened.close)
        tls = TlsState(opened.dup(), self._context)

        def find_in_tls() -> str | None:
            if tls.receive():
                with contextlib.suppress(OSError):
                    opened.sendall(tls.outgoing())  # of the handshake: there is room for it
            return find_stop(tls.waiting)

        def close() -> None:
            tls.release()
            opened.close()

        return Arrival(find_in_tls, lambda: self._take(opened, address, loop, tls), close)

    def _take(
        self,
        opened: socket.socket,
        address: str,
        loop: asyncio.AbstractEventLoop,
        tls: TlsState | None = None,
    ) -> None:
        if self._context is not None and len(self._entering) >= self._handshakes_max:
            self._make_room()
        if not self._may_enter(len(self._entering)):
            self.refused += 1
            opened.close()
            if tls is not None:
                tls.release()
            return
        arrived = [opened]
        task = loop.create_task(self._enter(arrived, loop, tls))
        self._entering[task] = address
        task.add_done_callback(lambda task: self._done(task, arrived))

    def _make_room(self) -> None:
        """End one handshake: whoever is silent must not keep others out, and others are likely elsewhere."""
        busiest, _ = Counter(self._entering.values()).most_common(1)[0]
        oldest = next(task for task, address in self._entering.items() if address == busiest)
        del self._entering[oldest]
        oldest.cancel()
        self.refused += 1

    async def _enter(
        self, arrived: list[socket.socket], loop: asyncio.AbstractEventLoop, tls: TlsState | None
    ) -> None:
        try:
            if self._context is None:
                await loop.connect_accepted_socket(self._make_protocol, arrived.pop())
            else:
                await serve_tls(self._make_protocol, arrived.pop(), self._context, HANDSHAKE_S, tls)
        except OSError:  # no TLS, not in time, or gone; errors of TLS are OSErrors as well
            return

    def _done(self, task: asyncio.Task[None], arrived: list[socket.socket]) -> None:
        self._entering.pop(task, None)
        for opened in arrived:  # it was cancelled before its first step
            opened.close()


def _address_of(opened: socket.socket) -> str:
    try:
        return str(opened.getpeername()[0])
    except OSError:  # it has left
        return "unknown"


def raise_files_limit() -> None:
    """Let this process have as many files open as it may; the usual limit of 1,024 is for select()."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    wanted = FILES_MAX if hard == resource.RLIM_INFINITY else min(hard, FILES_MAX)
    if soft != resource.RLIM_INFINITY and soft < wanted:
        resource.setrlimit(resource.RLIMIT_NOFILE, (wanted, hard))
