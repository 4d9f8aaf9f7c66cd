"""Listens on a TCP port and bounds what waits there, TLS handshakes included (asyncio).

The servers of asyncio keep any number of clients that never finish their handshake: they cannot count or
refuse them. So connections are accepted here (docs/adr/0013-network-edge.md).
"""

import asyncio
import functools
import resource
import socket
from collections import Counter
from collections.abc import Callable
from typing import TYPE_CHECKING, Final

from coordinator.ipc.server.acceptor import Acceptor, Arrival
from coordinator.ipc.server.stop_lane import StopLane, find_unread

if TYPE_CHECKING:  # it takes OpenSSL
    from coordinator.ipc.server.tls_transport import TlsServer, TlsState

HANDSHAKES_MAX: Final = 128
"""TLS handshakes at a time; for one more, the oldest of the address that has most of them is closed."""
HANDSHAKE_S: Final = 5.0
FILES_MAX: Final = 65_536
"""More than all connections and logs of a service need."""


def _always(_: int) -> bool:
    return True


def _nobody(_: str, _unread: bytes) -> None:
    return None


class TcpListener:
    """A TCP port, with TLS unless that is None. MAKE_PROTOCOL makes the protocol of each connection.

    MAY_ENTER gets how many connections are being set up, and returns whether there may be one more.
    STOP_LANE finds stops while the loop is held; FIND_STOP gets an address, and what came from there.
    """

    def __init__(
        self,
        make_protocol: Callable[[], asyncio.BaseProtocol],
        tls: "TlsServer | None",
        *,
        handshakes_max: int = HANDSHAKES_MAX,
        may_enter: Callable[[int], bool] = _always,
        stop_lane: StopLane | None = None,
        find_stop: Callable[[str, bytes], str | None] = _nobody,
    ) -> None:
        self._make_protocol = make_protocol
        self._tls = tls
        self._handshakes_max = handshakes_max
        self._may_enter = may_enter
        self._stop_lane = stop_lane or StopLane()
        self._find_stop = find_stop
        self._acceptors: list[Acceptor] = []
        self._entering: dict[asyncio.Task[None], str] = {}
        """Oldest first, with their addresses."""
        self.addresses: list[tuple[str, int]] = []
        """The addresses and ports that are open; 0.0.0.0 and :: stand for all addresses."""
        self.refused = 0
        """Connections that were closed before or during their handshake, for lack of room."""

    async def open(self, host: str, port: int) -> None:
        """Listen at HOST, any port if PORT is 0; raises OSError."""
        loop = asyncio.get_running_loop()
        server = await loop.create_server(asyncio.Protocol, host, port, start_serving=False)
        try:
            for bound in server.sockets:  # asyncio has resolved the addresses
                self.addresses.append(
                    bound.getsockname()[:2]
                )  # first: connections come in another thread, too
                self._acceptors.append(Acceptor(bound.dup(), self._stop_lane, self._arrive))
        except OSError:
            self.close()
            raise
        finally:
            server.close()

    @property
    def starved(self) -> int:
        """How often the system had no file left for a connection."""
        return sum(acceptor.starved for acceptor in self._acceptors)

    @property
    def entering(self) -> int:
        """How many connections are being set up: with TLS, shake hands."""
        return len(self._entering)

    def close(self) -> None:
        """Accept nobody any more, and end the handshakes; connections stay."""
        for acceptor in self._acceptors:
            acceptor.close()
        for task in self._entering:
            task.cancel()
        self._acceptors.clear()

    def _arrive(self, opened: socket.socket) -> Arrival:
        """Return how to look for a stop in what OPENED sends, and to serve it; in any thread."""
        address = _address_of(opened)
        find_stop = functools.partial(self._find_stop, address)
        tls = None if self._tls is None else self._tls.begin(opened.dup())
        find = functools.partial(find_unread, opened) if tls is None else tls.find_in
        return Arrival(
            opened,
            functools.partial(find, find_stop),
            functools.partial(self._take, opened, address, tls),
            functools.partial(self._give_up, opened, tls),
        )

    def _take(self, opened: socket.socket, address: str, tls: "TlsState | None") -> None:
        if self._tls is not None and len(self._entering) >= self._handshakes_max:
            self._make_room()
        if not self._may_enter(len(self._entering)):
            self.refused += 1
            self._stop_lane.settle(opened)
            self._give_up(opened, tls)
            return
        task = asyncio.get_running_loop().create_task(self._enter(opened, tls))
        self._entering[task] = address
        task.add_done_callback(functools.partial(self._end_entering, opened, tls))

    def _make_room(self) -> None:
        """End one handshake: whoever is silent must not keep others out, and others are likely elsewhere."""
        busiest, _ = Counter(self._entering.values()).most_common(1)[0]
        oldest = next(task for task, address in self._entering.items() if address == busiest)
        del self._entering[oldest]
        oldest.cancel()
        self.refused += 1

    async def _enter(self, opened: socket.socket, tls: "TlsState | None") -> None:
        if tls is None:
            await asyncio.get_running_loop().connect_accepted_socket(self._make_protocol, opened)
        else:
            await tls.serve(self._make_protocol, opened, HANDSHAKE_S)

    def _end_entering(self, opened: socket.socket, tls: "TlsState | None", task: asyncio.Task[None]) -> None:
        self._entering.pop(task, None)
        self._stop_lane.settle(opened)
        if task.cancelled() or isinstance(task.exception(), OSError):  # no TLS, not in time, or gone
            self._give_up(opened, tls)

    @staticmethod
    def _give_up(opened: socket.socket, tls: "TlsState | None") -> None:
        opened.close()
        if tls is not None:
            tls.release()


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
