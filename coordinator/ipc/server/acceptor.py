"""Accepts connections, and has the stop lane watch each of them from then on.

asyncio's servers accept a connection several iterations of the loop before its protocol exists. An emergency
stop on it would wait for all of them. Here the loop or the stop lane's thread accepts it, whoever is first
(docs/adr/0016-stop-path.md).
"""

import asyncio
import contextlib
import socket
import threading
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

from coordinator.ipc.server.stop_lane import Finder, StopLane

BACKLOG: Final = 128
RETRY_S: Final = 0.2
"""After the system had no file left for a connection."""
AHEAD_MAX: Final = 64
"""Connections that are accepted before the loop serves them; others wait for the loop."""


@dataclass(frozen=True, slots=True, eq=False)
class Arrival:
    """A connection that was accepted and has no protocol yet."""

    opened: socket.socket
    find: Finder
    serve: Callable[[], None]
    """Have the loop serve it; called on the loop."""
    close: Callable[[], None]


class Acceptor:
    """Accepts connections at LISTENER, a bound socket, on the running loop until ``close``, which closes it.

    ARRIVE gets each connection, in the thread that accepted it (the loop's or LANE's), and returns how to
    serve it. The code that serves it calls ``StopLane.settle`` once its protocol exists or serving has
    failed. Raises OSError, with LISTENER closed.
    """

    def __init__(
        self, listener: socket.socket, lane: StopLane, arrive: Callable[[socket.socket], Arrival]
    ) -> None:
        self._listener = listener
        self._lane = lane
        self._arrive = arrive
        self._loop = asyncio.get_running_loop()
        self._retry: asyncio.TimerHandle | None = None
        self._lock = threading.Lock()
        self._ahead: deque[Arrival] = deque()
        """Accepted by the lane's thread, and not served yet."""
        self._closed = False
        self.starved = 0
        """How often the system had no file left for a connection."""
        try:
            listener.setblocking(False)
            listener.listen(BACKLOG)
        except OSError:
            listener.close()
            raise
        self._loop.add_reader(listener, self._accept)
        lane.listen(listener, self._accept_ahead)

    def close(self) -> None:
        """Stop accepting; connections that are served stay open."""
        self._lane.listen_no_more(self._listener)
        self._loop.remove_reader(self._listener)
        if self._retry is not None:
            self._retry.cancel()
        with self._lock:
            self._closed = True
            self._listener.close()
            for arrival in self._ahead:
                self._give_up(arrival)
            self._ahead.clear()

    # ---- On the loop ----

    def _accept(self) -> None:
        """Take one: it costs a round of the loop as much as some requests do, and there may be thousands."""
        try:
            arrival = self._take()
        except (BlockingIOError, InterruptedError, ConnectionAbortedError):
            return
        except OSError:  # no file or memory for it: others may free some
            self.starved += 1
            self._loop.remove_reader(self._listener)
            self._retry = self._loop.call_later(RETRY_S, self._accept_again)
            return
        arrival.serve()

    def _accept_again(self) -> None:
        self._loop.add_reader(self._listener, self._accept)

    def _serve_ahead(self) -> None:
        """Serve one of those whom the lane's thread has accepted; the next one in the next round."""
        with self._lock:
            if not self._ahead:
                return  # they were given up
            arrival = self._ahead.popleft()
            if self._ahead:
                self._loop.call_soon(self._serve_ahead)
        arrival.serve()

    # ---- In both threads ----

    def _take(self) -> Arrival:
        opened, _ = self._listener.accept()
        try:
            opened.setblocking(False)
            arrival = self._arrive(opened)
        except OSError:
            opened.close()
            raise
        self._lane.watch_new(opened, arrival.find)
        return arrival

    def _give_up(self, arrival: Arrival) -> None:
        self._lane.settle(arrival.opened)
        arrival.close()

    # ---- In the lane's thread ----

    def _accept_ahead(self) -> None:
        while self._take_ahead():
            pass

    def _take_ahead(self) -> bool:
        """Have the loop serve one who has come; return whether there was one, and room."""
        with self._lock:  # of one at a time: the loop waits for it
            if self._closed or len(self._ahead) >= AHEAD_MAX:
                return False
            try:
                arrival = self._take()
            except OSError:
                return False
            self._ahead.append(arrival)
            if len(self._ahead) == 1:
                with contextlib.suppress(RuntimeError):  # the loop has ended: ``close`` gives it up
                    self._loop.call_soon_threadsafe(self._serve_ahead)
            return True
