"""Accepts TCP connections, so that those whose TLS handshake is not done yet are counted, too (asyncio)."""

import asyncio
import resource
import socket
import ssl
from collections.abc import Callable
from typing import Final

BACKLOG: Final = 128
HANDSHAKES_MAX: Final = 128
"""TLS handshakes at a time; who comes beyond that is let go at once, before it costs more than a file."""
HANDSHAKE_S: Final = 5.0
ACCEPTS_PER_ROUND: Final = 8
"""Connections taken before the rest of the loop gets its turn."""
RETRY_S: Final = 0.2
"""After the system had no file left for a connection."""
FILES_MAX: Final = 65_536
"""More than all connections and logs of a service need."""


def _open(_: int) -> bool:
    return True


class Door:
    """A TCP port, with TLS where there is a CONTEXT. PROTOCOLS makes the protocol of each connection.

    MAY_ENTER gets how many connections are on their way in, and says whether one more may come.
    """

    def __init__(
        self,
        protocols: Callable[[], asyncio.BaseProtocol],
        context: ssl.SSLContext | None,
        *,
        handshakes_max: int = HANDSHAKES_MAX,
        may_enter: Callable[[int], bool] = _open,
    ) -> None:
        self._protocols = protocols
        self._context = context
        self._handshakes_max = handshakes_max
        self._may_enter = may_enter
        self._listeners: list[socket.socket] = []
        self._accepting: list[asyncio.Task[None]] = []
        self._entering: set[asyncio.Task[None]] = set()
        self.refused = 0
        """Connections that were let go before their handshake."""
        self.starved = 0
        """Times that the system had no file left for one."""

    async def open(self, host: str, port: int) -> None:
        """Listen at HOST, any port if PORT is 0; raises OSError."""
        loop = asyncio.get_running_loop()
        server = await loop.create_server(asyncio.Protocol, host, port, start_serving=False)
        try:
            for bound in server.sockets:  # asyncio has found the addresses; accepting is ours
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
    def names(self) -> list[tuple[str, int]]:
        """The addresses and ports that are open; 0.0.0.0 and :: stand for all addresses."""
        return [listener.getsockname()[:2] for listener in self._listeners]

    def close(self) -> None:
        """Let nobody in any more, and go who is on the way."""
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
                opened, _ = await loop.sock_accept(listener)
            except ConnectionAbortedError:  # it has left already
                continue
            except OSError:  # no file or memory for it: others may give some back
                self.starved += 1
                await asyncio.sleep(RETRY_S)
                continue
            self._take(opened, loop)
            taken += 1
            if taken % ACCEPTS_PER_ROUND == 0:
                await asyncio.sleep(0)  # who waits already is accepted without a pause

    def _take(self, opened: socket.socket, loop: asyncio.AbstractEventLoop) -> None:
        full = self._context is not None and len(self._entering) >= self._handshakes_max
        if full or not self._may_enter(len(self._entering)):
            self.refused += 1
            opened.close()
            return
        arrived = [opened]
        task = loop.create_task(self._enter(arrived, loop))
        self._entering.add(task)
        task.add_done_callback(lambda task: self._done(task, arrived))

    async def _enter(self, arrived: list[socket.socket], loop: asyncio.AbstractEventLoop) -> None:
        limit_s = None if self._context is None else HANDSHAKE_S
        try:
            await loop.connect_accepted_socket(
                self._protocols,
                arrived.pop(),
                ssl=self._context,
                ssl_handshake_timeout=limit_s,
                ssl_shutdown_timeout=limit_s,
            )
        except OSError:  # no TLS, not in time, or gone; errors of TLS are OSErrors as well
            return

    def _done(self, task: asyncio.Task[None], arrived: list[socket.socket]) -> None:
        self._entering.discard(task)
        for opened in arrived:  # it was cancelled before its first step
            opened.close()


def raise_files_limit() -> None:
    """Let this process have as many files open as it may; the usual limit of 1,024 is for select()."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    wanted = FILES_MAX if hard == resource.RLIM_INFINITY else min(hard, FILES_MAX)
    if soft != resource.RLIM_INFINITY and soft < wanted:
        resource.setrlimit(resource.RLIMIT_NOFILE, (wanted, hard))
