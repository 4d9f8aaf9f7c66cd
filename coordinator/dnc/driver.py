"""Puts an engine on a port: bytes and time in, bytes out, events to the caller."""

import time
from collections.abc import Callable
from typing import Final, Protocol

from coordinator.dnc.engine import Engine, State
from coordinator.dnc.events import Event

POLL_S: Final = 1.0
"""Between two looks at what else may end the wait."""


class Line(Protocol):
    """What a driver needs of a port."""

    def read(self, timeout_s: float) -> bytes: ...  # noqa: D102
    def write(self, data: bytes, timeout_s: float) -> None: ...  # noqa: D102


class Driver:
    """One engine on one port, in the thread of who calls."""

    def __init__(self, port: Line, engine: Engine, clock: Callable[[], float] = time.monotonic) -> None:
        self.engine = engine
        self._port = port
        self._clock = clock

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
                self.engine.receive(data, now_s)
            else:
                self.engine.handle_timer(now_s)

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
