"""Puts an engine on a port: bytes and time in, bytes out, events to the caller."""

import time
from collections.abc import Callable
from typing import Final, Protocol

from coordinator.dnc.engine import Engine, State
from coordinator.dnc.events import Event

UNREADABLE_MIN: Final = 8
"""Characters that no header is in, of which somebody should hear."""
INSTANT_S: Final = 1e-6
POLL_S: Final = 1.0
"""Between two looks at what else may end the wait."""


class Line(Protocol):
    """What a driver needs of a port."""

    def read(self, timeout_s: float) -> bytes: ...  # noqa: D102
    def write(self, data: bytes, timeout_s: float) -> None: ...  # noqa: D102


class Driver:
    """One engine on one port, in the thread of who calls.

    ON_UNREADABLE: called once when what comes to a peripheral that waits is nothing but noise.
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
        """Return what happened as soon as something did, or nothing at UNTIL_S; raises PortError."""
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
                self.engine.receive(data, self._came_s(now_s))
            else:
                self.engine.handle_timer(now_s)
            self._look_at_noise(len(data))

    def _came_s(self, now_s: float) -> float:
        """Return when what was read at NOW_S came.

        A busy computer lets this side look late. What is there before a deadline was acted on counts as in
        time, else the wait would look like silence on the line: the end of a block, or no other answer.
        """
        deadline_s = self.engine.next_deadline()
        return now_s if deadline_s is None else min(now_s, deadline_s - INSTANT_S)

    def _look_at_noise(self, count: int) -> None:
        if self.engine.state is not State.IDLE or not self.engine.is_peripheral:
            self._unread = 0
            return
        self._unread += count
        judged = self.engine.next_deadline() is None
        if judged and self._unread >= UNREADABLE_MIN and self._on_unreadable is not None:
            self._on_unreadable()
            self._on_unreadable = None

    def flush(self) -> None:
        """Send what the engine has to say."""
        if output := self.engine.take_output():
            options = self.engine.options
            self._port.write(output, options.answer_s + 2 * len(output) * options.character_time_s)

    def give_up(self, sentence: str) -> None:
        """End what is on, so that the other side knows; raises PortError."""
        if self.engine.state is not State.IDLE:
            self.engine.fail(sentence)
            self.flush()
