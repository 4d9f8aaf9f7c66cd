"""One client of the API: what it has sent and nobody has looked at yet, and what it listens to; no I/O."""

import contextlib
from collections.abc import Mapping
from typing import Any, Final

from coordinator.klippy_api.move_dump import MoveDump
from coordinator.klippy_api.step_dump import StepDump
from coordinator.klippy_api.subscription import Subscription
from coordinator.klippy_api.wire import (
    MESSAGE_BYTES_MAX,
    Framer,
    Request,
    UnreadableError,
    is_urgent,
    read_request,
)

RUNNING_MAX: Final = 64
"""Calls of one client that run; more are answered with an error."""
REMOTE_METHODS_MAX: Final = 64
DUMPS_MAX: Final = 16
"""Dumps of moves that one client receives, and of steppers as many."""


class Client:
    """A client that PEER names for the log."""

    def __init__(self, peer: str) -> None:
        self.peer = peer
        self.subscription: Subscription | None = None
        self.output: Mapping[str, Any] | None = None
        """The template of lines that g-code answers; None: it does not listen to them."""
        self.remote_methods: dict[str, Mapping[str, Any]] = {}
        """Templates by name."""
        self.move_dumps: list[MoveDump] = []
        self.step_dumps: list[StepDump] = []
        self.running = 0
        """Calls that are not answered yet."""
        self.dropped = 0
        """Messages that could not be understood."""
        self._framer = Framer()

    @property
    def listens(self) -> bool:
        """Whether it wants to hear what changes."""
        return bool(self.subscription is not None or self.move_dumps or self.step_dumps)

    @property
    def has_work(self) -> bool:
        """Whether messages wait."""
        return self._framer.has_message

    def receive(self, data: bytes | memoryview) -> None:
        """Take what came; ``next_request`` looks at it."""
        self._framer.feed(data)

    def next_request(self) -> Request | None:
        """Return the call that is next, one that stops the machine first; None: there is none.

        Raises UnreadableError for a message that is dropped, TooLongError for one that ends the connection.
        """
        urgent = self._framer.next_urgent()
        message = self._framer.next_message() if urgent is None else (urgent, False)
        if message is None:
            return None
        try:
            return read_request(message[0], overtaken=message[1])
        except UnreadableError:
            self.dropped += 1
            raise

    def next_urgent(self) -> Request | None:
        """Return the next call that may stop the machine; None: there is none. Raises TooLongError."""
        while (urgent := self._framer.next_urgent()) is not None:
            with contextlib.suppress(UnreadableError):
                return read_request(urgent)
        return None

    def unread_calls(self, unread: bytes) -> list[Request]:
        """Return the calls that may stop the machine, of those that wait and in UNREAD; in any thread."""
        found = []
        for body in self._framer.messages(unread):
            if is_urgent(body) and len(body) <= MESSAGE_BYTES_MAX:
                with contextlib.suppress(UnreadableError):
                    found.append(read_request(body))
        return found

    def register(self, name: str, template: Mapping[str, Any]) -> bool:
        """Remember a remote method; return whether there was room."""
        if name not in self.remote_methods and len(self.remote_methods) >= REMOTE_METHODS_MAX:
            return False
        self.remote_methods[name] = template
        return True
