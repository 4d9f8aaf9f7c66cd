"""Emergency stops that do not need the control loop: they are found where they wait, unread, in the kernel.

While the loop is held, a thread (support/loop_watchdog.py) looks at what clients have sent without taking
it, and stops the nodes when there is a stop from one who may stop them. The loop reads the same bytes when it
can, and answers them: that changes nothing any more. Sockets that accept connections are looked at, too,
because ``canductor estop`` comes with a new one.
"""

import asyncio
import contextlib
import functools
import os
import socket
import threading
from collections.abc import Callable, Hashable
from dataclasses import dataclass
from typing import Final

FindStop = Callable[[bytes], str | None]
"""Returns who stops the machine with bytes that are unread; None: nobody does. In any thread."""
Finder = Callable[[], str | None]
PEEK_BYTES: Final = 262_144
ACCEPTED_MAX: Final = 64
"""Connections that are accepted during one hold; others wait for the loop."""


@dataclass(frozen=True, slots=True)
class _Listener:
    listening: socket.socket
    loop: asyncio.AbstractEventLoop
    make: Callable[[], asyncio.BaseProtocol]
    """Makes the protocol of a connection."""
    find_stop: Callable[[socket.socket, bytes], str | None]
    """For a connection that nobody has read from."""


class StopLane:
    """Looks at what is unread; STOP is called with who stops the machine, in the lane's thread."""

    def __init__(self, stop: Callable[[str], None]) -> None:
        self._stop = stop
        self._lock = threading.Lock()
        self._unread: dict[Hashable, tuple[socket.socket, FindStop]] = {}
        self._finders: list[Finder] = []
        self._listeners: list[_Listener] = []
        self._accepted: list[tuple[socket.socket, FindStop]] = []
        self._tasks: set[asyncio.Task[None]] = set()

    # ---- On the loop ----

    def watch(self, key: Hashable, connection: socket.socket, find_stop: FindStop) -> None:
        """Look at what CONNECTION has unread, with FIND_STOP, until ``forget`` of KEY."""
        with contextlib.suppress(OSError):  # it has closed already
            own = socket.socket(fileno=os.dup(connection.fileno()))
            with self._lock:
                self._unread[key] = own, find_stop

    def forget(self, key: Hashable) -> None:
        """Look at it no more; without effect for an unknown KEY."""
        with self._lock:
            found = self._unread.pop(key, None)
            if found is not None:
                found[0].close()

    def listen(
        self,
        listener: socket.socket,
        loop: asyncio.AbstractEventLoop,
        make: Callable[[], asyncio.BaseProtocol],
        find_stop: Callable[[socket.socket, bytes], str | None],
    ) -> None:
        """Accept what waits at LISTENER during a hold, and look at it; LOOP serves it, as MAKE says."""
        with self._lock:
            self._listeners.append(_Listener(listener, loop, make, find_stop))

    def look_also(self, find: Finder) -> None:
        """Ask FIND as well: it looks where there is no socket."""
        with self._lock:
            self._finders.append(find)

    def close(self) -> None:
        """Let go of all."""
        with self._lock:
            for own, _ in (*self._unread.values(), *self._accepted):
                own.close()
            self._unread.clear()
            self._accepted.clear()
            self._listeners.clear()
            self._finders.clear()

    # ---- In the lane's thread ----

    def look(self) -> None:
        """Look at everything once."""
        with self._lock:
            self._accept()
            found = [find() for find in self._finders]
            found += [_found(own, find) for own, find in (*self._unread.values(), *self._accepted)]
        for who in found:
            if who is not None:
                self._stop(who)
                return

    def _accept(self) -> None:
        for listener in self._listeners:
            while len(self._accepted) < ACCEPTED_MAX:
                try:
                    accepted, _ = listener.listening.accept()
                except OSError:
                    break
                accepted.setblocking(False)
                own = accepted.dup()
                self._accepted.append((own, functools.partial(listener.find_stop, own)))
                try:
                    listener.loop.call_soon_threadsafe(self._hand_over, listener, accepted)
                except RuntimeError:  # the loop has ended
                    accepted.close()

    def _hand_over(self, listener: _Listener, accepted: socket.socket) -> None:
        """Have the loop serve ACCEPTED, and forget what was accepted: on the loop."""
        with self._lock:
            for own, _ in self._accepted:
                own.close()
            self._accepted.clear()
        task = listener.loop.create_task(self._serve(listener, accepted))
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

    async def _serve(self, listener: _Listener, accepted: socket.socket) -> None:
        try:
            await listener.loop.connect_accepted_socket(listener.make, accepted)
        except OSError:  # it has left
            accepted.close()


def _found(own: socket.socket, find_stop: FindStop) -> str | None:
    try:
        data = own.recv(PEEK_BYTES, socket.MSG_PEEK | socket.MSG_DONTWAIT)
    except OSError:
        data = b""
    return find_stop(data)
