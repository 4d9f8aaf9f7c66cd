"""Listens on a TCP port and bounds what waits there, TLS handshakes included (asyncio).

The servers of asyncio keep any number of clients that never finish their handshake: they cannot count or
refuse them. So connections are accepted here (docs/adr/0013-network-edge.md).
"""

import asyncio
import resource
import socket
import ssl
from collections import Counter
from collections.abc import Callable
from typing import Final

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


class TcpListener:
    """A TCP port, with TLS where there is a CONTEXT. MAKE_PROTOCOL makes the protocol of each connection.

    MAY_ENTER gets how many connections are being set up, and returns whether there may be one more.
    """

    def __init__(
        self,
        make_protocol: Callable[[], asyncio.BaseProtocol],
        context: ssl.SSLContext | None,
        *,
        handshakes_max: int = HANDSHAKES_MAX,
        may_enter: Callable[[int], bool] = _always,
    ) -> None:
        self._make_protocol = make_protocol
        self._context = context
        self._handshakes_max = handshakes_max
        self._may_enter = may_enter
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

    def _take(self, opened: socket.socket, address: str, loop: asyncio.AbstractEventLoop) -> None:
        if self._context is not None and len(self._entering) >= self._handshakes_max:
            self._make_room()
        if not self._may_enter(len(self._entering)):
            self.refused += 1
            opened.close()
            return
        arrived = [opened]
        task = loop.create_task(self._enter(arrived, loop))
        self._entering[task] = address
        task.add_done_callback(lambda task: self._done(task, arrived))

    def _make_room(self) -> None:
        """End one handshake: whoever is silent must not keep others out, and others are likely elsewhere."""
        busiest, _ = Counter(self._entering.values()).most_common(1)[0]
        oldest = next(task for task, address in self._entering.items() if address == busiest)
        del self._entering[oldest]
        oldest.cancel()
        self.refused += 1

    async def _enter(self, arrived: list[socket.socket], loop: asyncio.AbstractEventLoop) -> None:
        limit_s = None if self._context is None else HANDSHAKE_S
        try:
            await loop.connect_accepted_socket(
                self._make_protocol,
                arrived.pop(),
                ssl=self._context,
                ssl_handshake_timeout=limit_s,
                ssl_shutdown_timeout=limit_s,
            )
        except OSError:  # no TLS, not in time, or gone; errors of TLS are OSErrors as well
            return

    def _done(self, task: asyncio.Task[None], arrived: list[socket.socket]) -> None:
        self._entering.pop(task, None)
        for opened in arrived:  # it was cancelled before its first step
            opened.close()


def raise_files_limit() -> None:
    """Let this process have as many files open as it may; the usual limit of 1,024 is for select()."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    wanted = FILES_MAX if hard == resource.RLIM_INFINITY else min(hard, FILES_MAX)
    if soft != resource.RLIM_INFINITY and soft < wanted:
        resource.setrlimit(resource.RLIMIT_NOFILE, (wanted, hard))
