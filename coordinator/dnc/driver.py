"""Connects an engine with a port: bytes and time in, bytes out, events to the caller."""

import time
from collections.abc import Callable
from typing import Final, Protocol

from coordinator.dnc.protocol.engine import Engine, State
from coordinator.dnc.protocol.events import Event

UNREADABLE_MIN: Final = 8
"""Received characters without a header after which ON_UNREADABLE is called."""
INSTANT_S: Final = 1e-6
POLL_S: Final = 1.0
"""Maximum duration of one read."""


class Line(Protocol):
    """The interface of a port."""

    def read(self, timeout_s: float) -> bytes: ...  # noqa: D102
    def write(self, data: bytes, timeout_s: float) -> None: ...  # noqa: D102


class Driver:
    """One engine on one port; runs in the caller's thread.

    ON_UNREADABLE: called once when a waiting peripheral receives only noise.
    """

    def __init__(
        self,
        port: Line,
        engine: Engine,
        clock: Callable[[], float] = time.monotonic,
        on_unreadable: Callable[[], None] | None = None,
    ) -> None:
        self.engine = engine
        self._port = port
        self._clock = clock
        self._unread = 0
        """Characters since the last transfer."""
        self._on_unreadable = on_unreadable

    def wait(self, until_s: float | None = None) -> list[Event]:
        """Wait for events and return them; none at UNTIL_S. Raises PortError."""
        while True:
            self.flush()
            if events := self.engine.take_events():
                return events
            now_s = self._clock()
            if until_s is not None and now_s >= until_s:
                return []
            due_s = min(d for d in (self.engine.next_deadline(), until_s, now_s + POLL_S) if d is not None)
            data = self._port.read(due_s - now_s)
            now_s = self._clock()
            if data:
                self.engine.receive(data, self._received_s(now_s))
            else:
                self.engine.handle_timer(now_s)
            self._count_noise(len(data))

    def _received_s(self, now_s: float) -> float:
        """Return when the bytes that were read at NOW_S arrived.

        On a busy computer they may be read late. Bytes that are there before a deadline is handled are in
        time; else the delay would look like silence on the line: the end of a block, or a missing answer.
        """
        deadline_s = self.engine.next_deadline()
        return now_s if deadline_s is None else min(now_s, deadline_s - INSTANT_S)

    def _count_noise(self, count: int) -> None:
        if self.engine.state is not State.IDLE or not self.engine.is_peripheral:
            self._unread = 0
            return
        self._unread += count
        judged = self.engine.next_deadline() is None
        if judged and self._unread >= UNREADABLE_MIN and self._on_unreadable is not None:
            self._on_unreadable()
            self._on_unreadable = None

    def flush(self) -> None:
        """Send the output of the engine."""
        if output := self.engine.take_output():
            options = self.engine.options
            self._port.write(output, options.answer_s + 2 * len(output) * options.character_time_s)

    def abort(self, sentence: str) -> None:
        """Abort a running transfer by EOT, for the reason SENTENCE; raises PortError."""
        if self.engine.state is not State.IDLE:
            self.engine.fail(sentence)
            self.flush()
