"""Accepts connections, and has the stop lane watch each of them from then on.

asyncio's servers accept a connection several iterations of the loop before its protocol exists. An emergency
stop on it would wait for the loop if that were held in between. While the loop is held, the stop lane's
thread accepts connections here (docs/adr/0016-stop-path.md).
"""

import asyncio
import socket
import threading
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

from coordinator.ipc.server.stop_lane import Finder, StopLane

BACKLOG: Final = 128
ACCEPTS_PER_ROUND: Final = 8
"""Connections taken before the rest of the loop gets its turn."""
RETRY_S: Final = 0.2
"""After the system had no file left for a connection."""
LOOKS: Final = 6
"""Rounds of the loop, all of them busy ones maybe, until a connection has its protocol and is read."""
HELD_MAX: Final = 64
"""Connections that are accepted while the loop is held; others wait for the loop."""


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
        self._held: list[Arrival] = []
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
        lane.listen(self, self._accept_while_held)

    def close(self) -> None:
        """Stop accepting; connections that are served stay open."""
        self._lane.forget(self)
        self._loop.remove_reader(self._listener)
        if self._retry is not None:
            self._retry.cancel()
        with self._lock:
            self._closed = True
            self._listener.close()
            for arrival in self._held:
                self._give_up(arrival)
            self._held.clear()

    # ---- On the loop ----

    def _accept(self) -> None:
        for _ in range(ACCEPTS_PER_ROUND):
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
            self._look_at(arrival, LOOKS)

    def _look_at(self, arrival: Arrival, looks: int) -> None:
        """Look for a stop in each round until somebody reads the connection: its turn may be far off."""
        if self._lane.look_at_new(arrival.opened) and looks > 1:
            self._loop.call_soon(self._look_at, arrival, looks - 1)

    def _accept_again(self) -> None:
        self._loop.add_reader(self._listener, self._accept)

    def _serve(self, arrival: Arrival) -> None:
        """Serve ARRIVAL, which the lane's thread has accepted."""
        with self._lock:
            if arrival not in self._held:
                return  # it was given up
            self._held.remove(arrival)
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

    def _accept_while_held(self) -> None:
        with self._lock:
            while not self._closed and len(self._held) < HELD_MAX:
                try:
                    arrival = self._take()
                except OSError:
                    return
                try:
                    self._loop.call_soon_threadsafe(self._serve, arrival)
                except RuntimeError:  # the loop has ended
                    self._give_up(arrival)
                else:
                    self._held.append(arrival)
