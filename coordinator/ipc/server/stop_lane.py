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
class Arrival:
    """A connection that was accepted during a hold."""

    find: Finder
    serve: Callable[[], None]
    """Let the loop serve it; called on the loop."""
    close: Callable[[], None]


@dataclass(frozen=True, slots=True)
class _Listener:
    listening: socket.socket
    loop: asyncio.AbstractEventLoop
    arrive: Callable[[socket.socket], Arrival]


class StopLane:
    """Looks at what is unread; STOP is called with who stops the machine, in the lane's thread."""

    def __init__(self, stop: Callable[[str], None]) -> None:
        self._stop = stop
        self._lock = threading.Lock()
        self._unread: dict[Hashable, Finder] = {}
        self._peeking: dict[Hashable, socket.socket] = {}
        self._finders: list[Finder] = []
        self._listeners: list[_Listener] = []
        self._accepted: list[Arrival] = []
        self._tasks: set[asyncio.Task[None]] = set()

    # ---- On the loop ----

    def watch(self, key: Hashable, connection: socket.socket, find_stop: FindStop) -> None:
        """Look at what CONNECTION has unread, with FIND_STOP, until ``forget`` of KEY."""
        with contextlib.suppress(OSError):  # it has closed already
            own = socket.socket(fileno=os.dup(connection.fileno()))
            with self._lock:
                self._peeking[key] = own
                self._unread[key] = functools.partial(find_unread, own, find_stop)

    def watch_with(self, key: Hashable, find: Finder) -> None:
        """Ask FIND, until ``forget`` of KEY: what is unread cannot be peeked at."""
        with self._lock:
            self._unread[key] = find

    def forget(self, key: Hashable) -> None:
        """Look at it no more; without effect for an unknown KEY."""
        with self._lock:
            self._unread.pop(key, None)
            if (own := self._peeking.pop(key, None)) is not None:
                own.close()

    def listen(
        self,
        listener: socket.socket,
        loop: asyncio.AbstractEventLoop,
        make: Callable[[], asyncio.BaseProtocol],
        find_stop: Callable[[socket.socket, bytes], str | None],
    ) -> None:
        """Accept what waits at LISTENER during a hold, and look at it; LOOP serves it later, as MAKE says.

        FIND_STOP is for a connection that nobody has read from.
        """

        def arrive(accepted: socket.socket) -> Arrival:
            find = functools.partial(find_stop, accepted)
            return Arrival(
                functools.partial(find_unread, accepted, find),
                functools.partial(self._serve, loop, make, accepted),
                accepted.close,
            )

        self.listen_with(listener, loop, arrive)

    def listen_with(
        self,
        listener: socket.socket,
        loop: asyncio.AbstractEventLoop,
        arrive: Callable[[socket.socket], Arrival],
    ) -> None:
        """Accept what waits at LISTENER during a hold; ARRIVE says, in that thread, what to do with it."""
        with self._lock:
            self._listeners.append(_Listener(listener, loop, arrive))

    def _serve(
        self,
        loop: asyncio.AbstractEventLoop,
        make: Callable[[], asyncio.BaseProtocol],
        accepted: socket.socket,
    ) -> None:
        task = loop.create_task(_connect(loop, make, accepted))
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

    def look_also(self, find: Finder) -> None:
        """Ask FIND as well: it looks where there is no socket."""
        with self._lock:
            self._finders.append(find)

    def close(self) -> None:
        """Let go of all."""
        with self._lock:
            for own in self._peeking.values():
                own.close()
            for arrival in self._accepted:
                arrival.close()
            self._unread.clear()
            self._peeking.clear()
            self._accepted.clear()
            self._listeners.clear()
            self._finders.clear()

    # ---- In the lane's thread ----

    def look(self) -> None:
        """Look at everything once."""
        with self._lock:
            self._accept()
            accepted = [arrival.find for arrival in self._accepted]
            found = [find() for find in (*self._finders, *self._unread.values(), *accepted)]
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
                arrival = listener.arrive(accepted)
                self._accepted.append(arrival)
                try:
                    listener.loop.call_soon_threadsafe(self._hand_over, arrival)
                except RuntimeError:  # the loop has ended
                    arrival.close()

    def _hand_over(self, arrival: Arrival) -> None:
        """Have the loop serve it, and look at it no more, unless the loop says so: on the loop."""
        with self._lock:
            if arrival not in self._accepted:
                return  # the lane was closed
            self._accepted.remove(arrival)
        arrival.serve()


def find_unread(opened: socket.socket, find_stop: FindStop) -> str | None:
    """Return who stops the machine with what OPENED has unread, which stays there."""
    try:
        data = opened.recv(PEEK_BYTES, socket.MSG_PEEK | socket.MSG_DONTWAIT)
    except OSError:
        data = b""
    return find_stop(data)


async def _connect(
    loop: asyncio.AbstractEventLoop, make: Callable[[], asyncio.BaseProtocol], accepted: socket.socket
) -> None:
    try:
        await loop.connect_accepted_socket(make, accepted)
    except OSError:  # it has left
        accepted.close()
