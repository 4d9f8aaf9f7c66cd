"""Emergency stops that do not need the control loop: they are found where they wait, unread, in the kernel.

While the loop is held, a thread (support/loop_watchdog.py) looks at what clients have sent without taking
it, and stops the nodes when there is a stop from one who may stop them. The loop reads the same bytes when it
can, and answers them: that changes nothing any more. Connections are accepted meanwhile, too (acceptor.py),
because ``canductor estop`` comes with a new one.
"""

import asyncio
import contextlib
import functools
import os
import socket
import threading
from asyncio.trsock import TransportSocket
from collections.abc import Callable, Hashable
from typing import Final

FindStop = Callable[[bytes], str | None]
"""Returns who stops the machine with bytes that are unread; None: nobody does. In any thread."""
Finder = Callable[[], str | None]
PEEK_BYTES: Final = 262_144


class EncryptedTransport(asyncio.Transport):
    """A transport whose socket has only encrypted bytes: a stop is found where they are decrypted."""

    def find_in(self, find: FindStop) -> str | None:
        """Return what FIND finds in what the client has sent and nobody has taken; in any thread."""
        raise NotImplementedError


def _ignore(_: str) -> None:
    pass


class StopLane:
    """Looks at what is unread; STOP is called with who stops the machine, in the thread that has looked."""

    def __init__(self, stop: Callable[[str], None] = _ignore) -> None:
        self._stop = stop
        self._lock = threading.Lock()
        self._unread: dict[Hashable, Finder] = {}
        self._new: dict[socket.socket, Finder] = {}
        """Of connections without a protocol."""
        self._peeking: dict[Hashable, socket.socket] = {}
        self._finders: list[Finder] = []
        self._accepting: dict[Hashable, Callable[[], None]] = {}

    # ---- On the loop ----

    def watch(self, key: Hashable, opened: socket.socket | TransportSocket, find_stop: FindStop) -> None:
        """Look at what OPENED has unread, with FIND_STOP, until ``forget`` of KEY; it is not new any more."""
        with contextlib.suppress(OSError):  # it has closed already
            own = socket.socket(fileno=os.dup(opened.fileno()))
            self._peeking[key] = own
            self.watch_with(key, opened, functools.partial(find_unread, own, find_stop))

    def watch_transport(
        self, key: Hashable, transport: asyncio.BaseTransport | None, find_stop: FindStop
    ) -> None:
        """Look at what TRANSPORT has unread, with TLS or without, until ``forget`` of KEY."""
        opened = None if transport is None else transport.get_extra_info("socket")
        if opened is None:
            return
        if isinstance(transport, EncryptedTransport):
            self.watch_with(key, opened, functools.partial(transport.find_in, find_stop))
        else:
            self.watch(key, opened, find_stop)

    def watch_with(self, key: Hashable, opened: socket.socket | TransportSocket, find: Finder) -> None:
        """Ask FIND about OPENED, until ``forget`` of KEY; it is not new any more."""
        with self._lock:
            self._unread[key] = find
            for new in [new for new in self._new if new.fileno() == opened.fileno()]:
                del self._new[new]

    def forget(self, key: Hashable) -> None:
        """Look at it no more, or listen there no more; without effect for an unknown KEY."""
        with self._lock:
            self._unread.pop(key, None)
            self._accepting.pop(key, None)
            if (own := self._peeking.pop(key, None)) is not None:
                own.close()

    def settle(self, opened: socket.socket) -> None:
        """Look no more at OPENED as a new connection: it has its protocol, or was given up."""
        with self._lock:
            self._new.pop(opened, None)

    def listen(self, key: Hashable, accept: Callable[[], None]) -> None:
        """Call ACCEPT at each look, until ``forget`` of KEY: it takes new connections."""
        with self._lock:
            self._accepting[key] = accept

    def look_also(self, find: Finder) -> None:
        """Ask FIND as well: it looks where there is no socket."""
        with self._lock:
            self._finders.append(find)

    def close(self) -> None:
        """Let go of all."""
        with self._lock:
            for own in self._peeking.values():
                own.close()
            self._unread.clear()
            self._new.clear()
            self._peeking.clear()
            self._accepting.clear()
            self._finders.clear()

    def look_at_new(self, opened: socket.socket) -> bool:
        """Look at OPENED, just accepted; return whether to look again: it is new still, and stops nothing."""
        with self._lock:
            find = self._new.get(opened)
            who = None if find is None else find()
        if who is not None:
            self._stop(who)
        return find is not None and who is None

    def find(self) -> str | None:
        """Return who stops the machine with what is unread; None: nobody. Stops nothing."""
        failures: list[Exception] = []
        with self._lock:
            who = self._find(failures)
        if who is None and failures:
            raise failures[0]
        return who

    # ---- On the loop, or in the lane's thread ----

    def watch_new(self, opened: socket.socket, find: Finder) -> None:
        """Ask FIND about OPENED, just accepted, until it is watched under a key, or ``settle`` of it."""
        with self._lock:
            self._new[opened] = find

    # ---- In the lane's thread ----

    def look(self) -> None:
        """Look at everything once; a failure hides no stop found elsewhere, and is raised at the end."""
        failures: list[Exception] = []
        with self._lock:
            accepting = list(self._accepting.values())
        for accept in accepting:
            try:
                accept()
            except Exception as error:  # noqa: BLE001 (as above)
                failures.append(error)
        with self._lock:
            who = self._find(failures)
        if who is not None:
            self._stop(who)
        if failures:
            raise failures[0]

    def _find(self, failures: list[Exception]) -> str | None:
        for find in (*self._finders, *self._unread.values(), *self._new.values()):
            try:
                who = find()
            except Exception as error:  # noqa: BLE001 (as above)
                failures.append(error)
                continue
            if who is not None:
                return who
        return None


def find_unread(opened: socket.socket, find_stop: FindStop) -> str | None:
    """Return who stops the machine with what OPENED has unread, which stays there."""
    try:
        data = opened.recv(PEEK_BYTES, socket.MSG_PEEK | socket.MSG_DONTWAIT)
    except OSError:
        data = b""
    return find_stop(data)
