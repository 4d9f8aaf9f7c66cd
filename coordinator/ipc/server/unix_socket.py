"""Unix sockets of the service: for the owner's programs only."""

import asyncio
import contextlib
import functools
import os
import socket
from collections.abc import Callable
from pathlib import Path

from coordinator.ipc.server.acceptor import Acceptor, Arrival
from coordinator.ipc.server.stop_lane import StopLane, find_unread
from nodes.support.errors import CanductorError
from nodes.support.host_sockets import folder_problem, socket_folders


class UnixListener:
    """A Unix socket. MAKE_PROTOCOL makes the protocol of each connection.

    LANE finds stops while the loop is held; FIND_STOP is for a connection that nobody has read from.
    """

    def __init__(
        self,
        make_protocol: Callable[[], asyncio.BaseProtocol],
        lane: StopLane,
        find_stop: Callable[[socket.socket, bytes], str | None],
    ) -> None:
        self._make_protocol = make_protocol
        self._lane = lane
        self._find_stop = find_stop
        self._acceptor: Acceptor | None = None
        self._path: Path | None = None
        self._serving: set[asyncio.Task[object]] = set()

    async def open(self, path: Path) -> None:
        """Listen at PATH, mode 0600; raises CanductorError."""
        await asyncio.to_thread(_make_way, path)
        try:
            self._acceptor = Acceptor(_bound_to(path), self._lane, self._arrive)
        except OSError as error:
            raise CanductorError(f"the socket {path} cannot be opened: {error.strerror or error}") from None
        self._path = path

    def close(self) -> None:
        """Accept nobody any more, and remove the socket; connections stay."""
        if self._acceptor is None or self._path is None:
            return
        self._acceptor.close()
        for task in self._serving:
            task.cancel()
        with contextlib.suppress(OSError):
            self._path.unlink()
        self._acceptor = None

    def _arrive(self, opened: socket.socket) -> Arrival:
        find = functools.partial(find_unread, opened, functools.partial(self._find_stop, opened))
        return Arrival(opened, find, functools.partial(self._serve, opened), opened.close)

    def _serve(self, opened: socket.socket) -> None:
        loop = asyncio.get_running_loop()
        task = loop.create_task(loop.connect_accepted_socket(self._make_protocol, opened))
        self._serving.add(task)
        task.add_done_callback(functools.partial(self._end_serving, opened))

    def _end_serving(self, opened: socket.socket, task: asyncio.Task[object]) -> None:
        self._serving.discard(task)
        self._lane.settle(opened)
        if task.cancelled() or task.exception() is not None:  # it has left, or this is closed
            opened.close()


def _bound_to(path: Path) -> socket.socket:
    listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    try:
        os.fchmod(listener.fileno(), 0o600)  # before there is a name, so that nobody can be faster
        listener.bind(str(path))
    except OSError:
        listener.close()
        raise
    return listener


def _make_way(path: Path) -> None:
    """Make the folder of PATH, and remove a socket that a dead coordinator left there."""
    try:
        path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        if path.parent in socket_folders() and (problem := folder_problem(path.parent)) is not None:
            raise CanductorError(f"the socket {path} cannot be opened: {problem}; choose another path")
        if not path.is_socket():
            if path.exists():
                raise CanductorError(f"{path} exists and is not a socket; choose another path or remove it")
            return
        with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as probe:
            probe.settimeout(1.0)
            try:
                probe.connect(str(path))
            except ConnectionRefusedError:
                path.unlink()
                return
    except OSError as error:
        raise CanductorError(f"the socket {path} cannot be opened: {error.strerror or error}") from None
    raise CanductorError(f"another coordinator serves at {path}; stop it, or choose another path")
