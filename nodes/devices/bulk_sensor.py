"""A fast sensor whose readings come from its node in bulk, many in a message.

The readings of one round are numbered; messages among them may be lost on the way. When they were made
follows from the numbers that the node tells with its clock.
"""

import asyncio
import contextlib
import math
from abc import abstractmethod
from collections import deque
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from typing import ClassVar, Final, Generic, Protocol, TypeVar

from nodes.devices.device import Device
from nodes.dictionary.message_format import Message
from nodes.node.node import Node
from nodes.support.errors import CanductorError

RESPONSES: Final = (
    "sensor_bulk_data oid=%c sequence=%hu data=%*s",
    "sensor_bulk_status oid=%c clock=%u next_sequence=%hu buffered=%u possible_overflows=%hu",
)
MESSAGE_BYTES: Final = 48
"""Of readings in a full message."""
READING_BYTES: Final = 4
READINGS: Final = MESSAGE_BYTES // READING_BYTES
"""In a full message."""
STATUS_S: Final = 0.1
"""Between two questions for the number of readings, which give their times."""
PATIENCE_S: Final = 1.0
"""For readings that are waited for."""


class SensorError(CanductorError):
    """The sensor does not measure; the sentence says why, without a full stop."""


class NumberedReading(Protocol):
    """One reading."""

    @property
    def number(self) -> int:
        """From 0 on since the readings began."""

    @property
    def error(self) -> str:
        """What is wrong with it; empty: nothing."""


R = TypeVar("R", bound=NumberedReading)


class BulkSensor(Device, Generic[R]):
    """A sensor that makes RATE_HZ readings per second; of them the last KEPT are remembered, or all."""

    QUERY: ClassVar[str]
    """The command that has its node read it every ``rest_ticks``."""
    STATUS: ClassVar[str]
    """The one that asks how many readings there were."""
    SILENT: ClassVar[str]
    """What is wrong where no readings come."""

    def __init__(self, description: str, *, rate_hz: float, kept: int | None = None) -> None:
        super().__init__(description)
        self.rate_hz = rate_hz
        self.readings: deque[R] = deque(maxlen=kept)
        """Since they began."""
        self.counts: deque[tuple[int, int]] = deque(maxlen=kept)
        """Clocks (32 bits) of the node, and how many readings there were."""
        self.overflows = 0
        """Readings that the node could not send, of this round."""
        self._rest_ticks = 1
        self._users = 0
        self._listening = False
        self._sequence = 0
        self._came = asyncio.Event()
        self._restarting: asyncio.Task[None] | None = None
        self.heard_s = -math.inf
        """When the last message came, by the control loop's clock."""

    @abstractmethod
    async def wake(self, node: Node) -> None:
        """Prepare the sensor for readings; raises SensorError."""

    @abstractmethod
    def reading(self, number: int, content: bytes) -> R:
        """Return the reading of that NUMBER, by the bytes of the node."""

    def started(self, node: Node) -> None:
        """Listen to NODE, which has become ready."""
        self._on_report(node, "sensor_bulk_data", self._take)
        if self._users:  # it was lost, and begins anew
            self._restarting = asyncio.create_task(self._restart(node))

    async def _restart(self, node: Node) -> None:
        with contextlib.suppress(CanductorError):  # whoever waits for readings hears that
            await self._start(node)

    @asynccontextmanager
    async def sampling(self, node: Node) -> AsyncIterator[None]:
        """Have readings come meanwhile; raises SensorError."""
        await self.begin(node)
        try:
            yield
        finally:
            self.end(node)

    @property
    def is_sampling(self) -> bool:
        """Whether readings come."""
        return self._users > 0

    async def begin(self, node: Node) -> None:
        """Have readings come until ``end``, which is called as often as this; raises SensorError."""
        self._users += 1
        try:
            if self._users == 1:
                await self._start(node)
        except BaseException:
            self.end(node)
            raise

    def end(self, node: Node) -> None:
        """Have no more readings come, unless somebody else needs them."""
        self._users -= 1
        if not self._users and node.talks:
            node.send(self.QUERY, oid=self._oid, rest_ticks=0)

    async def _start(self, node: Node) -> None:
        await self.wake(node)
        self._listening = False
        node.send(self.QUERY, oid=self._oid, rest_ticks=self._rest_ticks)
        # What comes from now on is no message that was on its way before.
        self._sequence = self.overflows = 0
        self.readings.clear()
        self.counts.clear()
        await self.count(node)
        self._listening = True

    def _take(self, message: Message) -> None:
        """Take a message of readings; others may have been lost before it."""
        if not self._listening:
            return  # of an earlier round
        data = message.data("data")
        self._sequence = self._whole(message.integer("sequence"))
        for at in range(0, len(data) - READING_BYTES + 1, READING_BYTES):
            number = self._sequence * READINGS + at // READING_BYTES
            self.readings.append(self.reading(number, data[at : at + READING_BYTES]))
        self.heard_s = asyncio.get_running_loop().time()
        self._came.set()

    def _whole(self, sequence: int) -> int:
        """Return which number SEQUENCE (16 bits) stands for: the nearest one to the last."""
        return self._sequence + (sequence - self._sequence + (1 << 15)) % (1 << 16) - (1 << 15)

    async def count(self, node: Node) -> int:
        """Return how many readings there were by now; raises SensorError when some were lost."""
        answer = await node.query(self.STATUS, "sensor_bulk_status", oid=self._oid)
        self.overflows = answer.integer("possible_overflows")
        if self.overflows:
            raise SensorError(
                "readings were lost, as the node could not send them: check the bus for errors and load"
            )
        whole = self._whole(answer.integer("next_sequence")) * READINGS
        count = whole + answer.integer("buffered") // READING_BYTES
        self.counts.append((answer.integer("clock"), count))
        return count

    async def next_readings(self, node: Node, size: int) -> list[R]:
        """Return SIZE readings that begin from now on; raises SensorError for a bad one or none.

        Messages may get lost on the way, so they need not follow each other.
        """
        first = await self.count(node) + 1  # the one that is being made may have begun before
        try:
            async with asyncio.timeout(PATIENCE_S + (size + READINGS) / self.rate_hz):
                while len(found := [one for one in self.readings if one.number >= first]) < size:
                    self._came.clear()
                    await self._came.wait()
        except TimeoutError:
            node_failure = node.failure
            if node_failure is not None:
                raise node_failure.with_traceback(None) from None
            raise SensorError(self.SILENT) from None
        return checked(found[:size])


def checked(readings: list[R]) -> list[R]:
    """Return READINGS; raises SensorError where one is bad."""
    bad = next((reading.error for reading in readings if reading.error), "")
    if bad:
        raise SensorError(bad)
    return readings
