"""When the readings of a sensor were made: by how many there were, each time its node was asked."""

import asyncio
import contextlib
from collections.abc import Sequence

from coordinator.runtime.module_context import ModuleContext
from coordinator.support.lazy_numpy import Numbers, np
from nodes.devices.bulk_sensor import STATUS_S, BulkSensor, NumberedReading, R
from nodes.support.errors import CanductorError


class ReadingTimes:
    """Asks for the number of readings of SENSOR, on node NODE_NAME, from ``begin`` to ``end``."""

    def __init__(self, live: ModuleContext, node_name: str, sensor: BulkSensor[R]) -> None:
        self._live, self._node_name, self._sensor = live, node_name, sensor
        self._asking: asyncio.Task[None] | None = None
        self._counted: list[tuple[float, int]] = []
        """Print times, s, and how many readings there were."""

    def begin(self) -> None:
        """Begin to ask."""
        self._asking = asyncio.create_task(self._ask())

    async def _ask(self) -> None:
        with contextlib.suppress(CanductorError):
            while True:
                await self.count()
                await asyncio.sleep(STATUS_S)

    async def count(self) -> None:
        """Ask once; raises SensorError. The node's clock of 32 bits is soon ambiguous, its time is not."""
        count = await self._sensor.count(self._live.node(self._node_name))
        clock, _ = self._sensor.counts[-1]
        self._counted.append((self._live.print_time_of(self._node_name, clock), count))

    def end(self) -> bool:
        """Ask no more; return whether it was asking."""
        asking, self._asking = self._asking, None
        if asking is not None:
            asking.cancel()
        return asking is not None

    def middles(self, readings: Sequence[NumberedReading]) -> Numbers:
        """Return the print times of the middles of the conversions of READINGS, s.

        When COUNT readings are there, the last of them ended half a conversion before, on average.
        """
        clocks_s, counts = np.array(self._counted).T
        period_s, begin_s = np.polyfit(counts, clocks_s, 1)
        numbers = np.array([reading.number for reading in readings], dtype=np.float64)
        return np.asarray(begin_s + period_s * numbers, dtype=np.float64)
