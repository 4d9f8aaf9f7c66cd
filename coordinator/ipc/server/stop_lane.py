"""Emergency stops that do not need the control loop: they are found where they wait, unread, in the kernel.

While the loop is held, a thread (support/loop_watchdog.py) looks at what clients have sent without taking
it, and stops the nodes when there is a stop from one who may stop them. The loop reads the same bytes when it
can, and answers them: that changes nothing any more. ``canductor estop`` comes with a new connection, which
takes the loop several rounds: the thread accepts (acceptor.py) and looks at new connections at any time.
"""

import asyncio
import contextlib
import functools
import os
import select
import socket
import threading
from asyncio.trsock import TransportSocket
from collections.abc import Callable, Hashable, Iterator
from typing import Any, Final

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


def _nothing() -> None:
    pass


def _to_the_end() -> bool:
    return True


class StopLane:
    """Looks at what is unread; STOP is called with who stops the machine, in the thread that has looked.

    A look takes tens of ms when many clients have sent much. It ends when the loop goes on, and the loop
    waits for one finder at most, which ends early (``goes_on``) where it would take long.
    """

    def __init__(self, stop: Callable[[str], None] = _ignore) -> None:
        self._stop = stop
        self._lock = threading.Lock()
        """For one finder at a time."""
        self._next = threading.Lock()
        """Of who takes the lock next: a look, which takes it again and again, has to wait its turn."""
        self._unread: dict[Hashable, Finder] = {}
        self._new: dict[socket.socket, Finder] = {}
        """Of connections without a protocol."""
        self._peeking: dict[Hashable, socket.socket] = {}
        self._others: dict[Finder, Finder] = {}
        self._accepting: dict[socket.socket, Callable[[], object]] = {}
        self._epoll = select.epoll()
        """Of sockets that listen and of new connections; edge-triggered."""
        self._goes_on: Callable[[], bool] = _to_the_end
        """Of who has the lock."""
        self._callbacks: dict[int, Callable[[], object]] = {}
        """By their descriptors."""
        self.events_fd: Final = self._epoll.fileno()
        """Readable when ``handle_events`` has something to do."""

    @contextlib.contextmanager
    def _turn(self) -> Iterator[None]:
        with self._next:
            self._lock.acquire()
        try:
            yield
        finally:
            self._lock.release()

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
        with self._turn():
            self._unread[key] = find
            for new in [new for new in self._new if new.fileno() == opened.fileno()]:
                self._settle(new)

    def forget(self, key: Hashable) -> None:
        """Look at it no more; without effect for an unknown KEY."""
        with self._turn():
            self._unread.pop(key, None)
            if (own := self._peeking.pop(key, None)) is not None:
                own.close()

    def settle(self, opened: socket.socket) -> None:
        """Look no more at OPENED as a new connection: it has its protocol, or was given up."""
        with self._turn():
            self._settle(opened)

    def _settle(self, opened: socket.socket) -> None:
        if self._new.pop(opened, None) is not None:
            self._unregister(opened)

    def listen(self, listener: socket.socket, accept: Callable[[], object]) -> None:
        """Call ACCEPT when LISTENER has connections and at each look, until ``listen_no_more``."""
        with self._turn():
            self._accepting[listener] = accept
            self._register(listener, accept)

    def listen_no_more(self, listener: socket.socket) -> None:
        """End that; LISTENER may be closed then."""
        with self._turn():
            if self._accepting.pop(listener, None) is not None:
                self._unregister(listener)

    def look_also(self, find: Finder) -> None:
        """Ask FIND as well: it looks where there is no socket."""
        with self._turn():
            self._others[find] = find

    def close(self) -> None:
        """Let go of all."""
        with self._turn():
            for own in self._peeking.values():
                own.close()
            self._epoll.close()
            self._callbacks.clear()
            self._unread.clear()
            self._new.clear()
            self._peeking.clear()
            self._accepting.clear()
            self._others.clear()

    def find(self) -> str | None:
        """Return who stops the machine with what is unread; None: nobody. Stops nothing."""
        failures: list[Exception] = []
        who = self._find(failures, _to_the_end, _to_the_end)
        if who is None and failures:
            raise failures[0]
        return who

    # ---- On the loop, or in the lane's thread ----

    def watch_new(self, opened: socket.socket, find: Finder) -> None:
        """Ask FIND about OPENED, just accepted, until it is watched under a key, or ``settle`` of it."""
        with self._turn():
            self._new[opened] = find
            self._register(opened, functools.partial(self._look_at_new, opened))

    def _register(self, opened: socket.socket, call: Callable[[], object]) -> None:
        """Have ``handle_events`` CALL when OPENED becomes readable, or is."""
        if self._epoll.closed:
            return
        with contextlib.suppress(OSError):  # without room for it, it waits until the loop is held
            self._epoll.register(opened, select.EPOLLIN | select.EPOLLET)
            self._callbacks[opened.fileno()] = call

    def _unregister(self, opened: socket.socket) -> None:
        if opened.fileno() >= 0 and not self._epoll.closed:  # a closed one is out already
            self._callbacks.pop(opened.fileno(), None)
            with contextlib.suppress(FileNotFoundError):
                self._epoll.unregister(opened)

    # ---- In the lane's thread ----

    def handle_events(self) -> None:
        """Accept new connections, and look at what they have sent since the last call.

        A failure hides no stop found elsewhere, and is raised at the end.
        """
        failures: list[Exception] = []
        for fd, _ in self._epoll.poll(0):
            try:
                self._callbacks.get(fd, _nothing)()
            except Exception as error:  # noqa: BLE001 (as above)
                failures.append(error)
        if failures:
            raise failures[0]

    def _look_at_new(self, opened: socket.socket) -> None:
        who = self._ask(self._new, opened, self._is_alone)
        if who is not None:
            self._stop(who)

    def look(self, is_held: Callable[[], bool] = _to_the_end) -> None:
        """Look at everything once, while IS_HELD says that the loop does not read it itself.

        A failure hides no stop found elsewhere, and is raised at the end.
        """
        failures: list[Exception] = []
        with self._turn():
            accepting = list(self._accepting.values())
        for accept in accepting:
            try:
                accept()
            except Exception as error:  # noqa: BLE001 (as above)
                failures.append(error)
        who = self._find(failures, is_held, lambda: is_held() and self._is_alone())
        if who is not None:
            self._stop(who)
        if failures:
            raise failures[0]

    # ---- On the loop, or in the lane's thread ----

    def goes_on(self) -> bool:
        """Return whether the finder that is asked may take longer; not if the loop could read by itself."""
        return self._goes_on()

    def _is_alone(self) -> bool:
        """Return whether nobody waits for the lock."""
        return not self._next.locked()

    def _ask(self, table: dict[Any, Finder], key: Any, goes_on: Callable[[], bool]) -> str | None:
        """Return what the finder of KEY in TABLE finds while it GOES_ON, if there still is one."""
        with self._turn():
            self._goes_on = goes_on
            find = table.get(key)
            return None if find is None else find()

    def _find(
        self, failures: list[Exception], is_held: Callable[[], bool], goes_on: Callable[[], bool]
    ) -> str | None:
        """Ask all finders while IS_HELD, each as long as it GOES_ON."""
        tables: tuple[dict[Any, Finder], ...] = self._others, self._unread, self._new
        with self._turn():
            watched = [(table, key) for table in tables for key in table]
        for table, key in watched:
            if not is_held():
                return None
            try:
                who = self._ask(table, key, goes_on)
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
