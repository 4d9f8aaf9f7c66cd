"""What a client gets without a call for each: updates of the state, and notifications."""

import asyncio
from collections import deque
from dataclasses import dataclass, field
from typing import Any, Final

from coordinator.ipc.protocol.methods import ApiError
from coordinator.ipc.server.state import FieldFilter
from coordinator.support.values import Value

EVENTS_MAX: Final = 1_024
"""Notifications that wait to be taken."""


@dataclass(slots=True)
class Update:
    """What changed up to SEQUENCE. SNAPSHOT: these are all fields; what was known before is void."""

    sequence: int
    values: dict[str, Value] = field(default_factory=dict)
    removed: set[str] = field(default_factory=set)
    snapshot: bool = False


@dataclass(frozen=True, slots=True)
class Event:
    """A notification."""

    name: str
    values: dict[str, Value]


class Watch:
    """One watch: merges updates until they are taken, and notices gaps."""

    def __init__(self, fields: list[str], rate_hz: float) -> None:
        self.fields = fields
        self.rate_hz = rate_hz
        self.number: int | None = None
        self.gaps = 0
        self._sequence = 0
        self._merged: Update | None = None
        self._failure: ApiError | None = None
        self._changed = asyncio.Event()

    def begin(self, number: int, sequence: int, values: dict[str, Value]) -> None:
        """Begin (again) with a snapshot."""
        self.number, self._sequence = number, sequence
        self._merged = Update(sequence, values, snapshot=True)
        self._changed.set()

    def take(self, message: dict[str, Any]) -> bool:
        """Merge an update into what waits; False: one is missing before it."""
        if message["since"] != self._sequence and not message["snapshot"]:
            self.gaps += 1
            return False
        self._sequence = message["sequence"]
        values, removed = message["values"], message["removed"]
        if message["snapshot"] or self._merged is None:
            self._merged = Update(self._sequence, values, set(removed), message["snapshot"])
        else:
            merged = self._merged
            merged.sequence = self._sequence
            for path in removed:
                merged.values.pop(path, None)
            merged.values |= values
            merged.removed = (merged.removed | set(removed)) - values.keys()
        self._changed.set()
        return True

    def fail(self, error: ApiError) -> None:
        """End with ERROR."""
        self._failure = error
        self._changed.set()

    async def next(self) -> Update:
        """Wait for an update; raises ApiError."""
        await self._changed.wait()
        if self._failure is not None:
            raise self._failure.with_traceback(None)
        self._changed.clear()
        update, self._merged = self._merged, None
        assert update is not None
        return update


class EventQueue:
    """Notifications that match NAMES, in order; the oldest are dropped."""

    def __init__(self, names: tuple[str, ...]) -> None:
        self.names = names
        self.dropped = 0
        self._wanted = FieldFilter((*names, "api.lost"))
        self._waiting: deque[Event] = deque()
        self._failure: ApiError | None = None
        self._changed = asyncio.Event()

    def put(self, event: Event) -> None:
        """Take EVENT if it is wanted."""
        if not self._wanted.matches(event.name):
            return
        self._waiting.append(event)
        if len(self._waiting) > EVENTS_MAX:
            self._waiting.popleft()
            self.dropped += 1
        self._changed.set()

    def fail(self, error: ApiError) -> None:
        """End with ERROR."""
        self._failure = error
        self._changed.set()

    async def next(self) -> Event:
        """Wait for a notification; raises ApiError."""
        while not self._waiting:
            if self._failure is not None:
                raise self._failure.with_traceback(None)
            self._changed.clear()
            await self._changed.wait()
        return self._waiting.popleft()
