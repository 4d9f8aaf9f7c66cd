"""A temperature that is measured periodically, whatever its source, and the tasks that wait for it."""

import asyncio
from collections.abc import Callable
from typing import Final

from coordinator.modules.base import Modules
from coordinator.runtime.module_context import ModuleContext
from nodes.support.errors import CanductorError

SILENT_S: Final = 10.0
"""How long a task waits for a measurement, which should come three times a second; a host may be suspended
for a while."""
MAX_WAITERS: Final = 64
BAD_IN_A_ROW: Final = 6
"""How many measurements in a row outside the limits stop the machine, where no node checks them."""

OnMeasured = Callable[[float, float], None]
"""Print time in s, °C."""


def _ignore(_at_s: float, _celsius: float) -> None:
    pass


class TemperatureSource:
    """The temperature of section NAME, which has to be MIN_C to MAX_C.

    ``on_measured`` is called with every measurement once it is connected.
    """

    def __init__(self, name: str, min_c: float, max_c: float) -> None:
        self.name = name
        self.min_c, self.max_c = min_c, max_c
        self.guarded = True
        """Whether readings outside the limits stop the machine."""
        self.celsius: float | None = None
        """The last measurement; None before the first."""
        self.sound_c: float | None = None
        """The last measurement within the limits; one outside comes from a broken wire, or from noise."""
        self.on_measured: OnMeasured = _ignore
        self.ratio: float | None = None
        """The last reading of its converter, 0 to 1; None: none yet, or there is no converter."""
        self.unhandled = False
        """Whether the last measurement could not be handled, because of a bug."""
        self._live: ModuleContext | None = None
        self._looks = 0
        self._bad = 0
        self._waiting: list[asyncio.Future[None]] = []
        self._over: str | None = None

    def link(self, modules: Modules) -> None:
        """Find what belongs to it; raises ConfigError."""

    async def connect(self, live: "ModuleContext") -> None:
        """Start reporting measurements."""
        self._live = live

    def end(self, cause: str) -> None:
        """Stop reporting and end all waiting, because of CAUSE."""
        self._over = cause
        self._live = None
        self.wake()

    @property
    def node(self) -> str:
        """The node it is on; empty: on none."""
        return ""

    @property
    def is_sound(self) -> bool:
        """Whether the last measurement is within the limits."""
        return self.celsius is not None and self.celsius == self.sound_c

    def missed(self) -> int:
        """Return how often this was called since the last measurement that was handled."""
        self._looks += 1
        return self._looks - 1

    async def next(self) -> None:
        """Wait for the next measurement; raises CanductorError when there will be none."""
        if self._over is not None:
            raise CanductorError(self._over)
        if len(self._waiting) >= MAX_WAITERS:
            raise CanductorError(f"more than {MAX_WAITERS} wait for the temperature of {self.name}; end some")
        waiter = asyncio.get_running_loop().create_future()
        self._waiting.append(waiter)
        try:
            async with asyncio.timeout(SILENT_S):
                await waiter
        except TimeoutError:
            there = f"; is its node {self.node} there?" if self.node else ""
            raise CanductorError(f"the sensor of [{self.name}] is silent{there}") from None
        finally:
            if waiter in self._waiting:
                self._waiting.remove(waiter)
        if self._over is not None:
            raise CanductorError(self._over)

    def _take(self, celsius: float, at_s: Callable[["ModuleContext"], float]) -> None:
        """Take a measurement; AT_S returns its print time on a connected machine."""
        self.celsius = celsius
        if self.min_c <= celsius <= self.max_c:
            self.sound_c = celsius
        if self._live is not None:
            self.unhandled = True  # so it remains if this raises
            self.on_measured(at_s(self._live), celsius)
            self.unhandled = False
        self._looks = 0
        if self._waiting:
            self.wake()

    def _watch(self, live: "ModuleContext", celsius: float) -> None:
        """Stop the machine when CELSIUS stays outside the limits: for sensors that no node checks."""
        if not self.guarded:
            return
        self._bad = 0 if self.min_c <= celsius <= self.max_c else self._bad + 1
        if self._bad == BAD_IN_A_ROW:
            live.stop(
                f"[{self.name}] reads {celsius:.0f} °C, outside its min_temp of {self.min_c:g} and max_temp"
                f" of {self.max_c:g} °C; find out why, or correct these"
            )

    def wake(self) -> None:
        """Wake all that wait for a measurement."""
        for waiter in self._waiting:
            if not waiter.done():
                waiter.set_result(None)
