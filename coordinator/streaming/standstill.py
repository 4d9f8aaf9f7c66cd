"""Performs what a program has to be done while the machine stands; the program waits for it."""

import asyncio
from collections.abc import Callable

from coordinator.gcode.events import Done, StandstillAction
from coordinator.runtime.machine import MachineStopped
from nodes.support.errors import CanductorError


class StandstillTask:
    """EVENT being performed on the running loop; ``look`` until it is over."""

    def __init__(self, event: StandstillAction) -> None:
        self._event = event
        self._has_begun = self._is_ending = False
        self._task = asyncio.ensure_future(self._perform())

    def when_over(self, call: Callable[[], None]) -> None:
        """Call CALL once ``look`` has a result."""
        self._task.add_done_callback(lambda _: call())

    def look(self) -> bool:
        """Cancel it if its event was cancelled; return whether it is over; the event has the result.

        Raises what performing it raised, but for a CanductorError, which the program gets. An action that
        failed or was cancelled may have moved something.
        """
        if self._event.cancelled and not self._is_ending:
            self._is_ending = True  # asked once: a second time would interrupt its tidying up
            self._task.cancel()
        if not self._task.done():
            return False
        event = self._event
        event.done, event.over = None, True
        if self._task.cancelled():
            event.moved = self._has_begun
        elif (error := self._task.exception()) is not None:
            if isinstance(error, MachineStopped) or not isinstance(error, CanductorError):
                raise error
            event.failure, event.moved = str(error), True
        else:
            event.done = self._task.result()
            event.moved = event.done.moved
        return True

    async def close(self) -> None:
        """Cancel it and wait for its end; whoever waits may be cancelled, too, which comes after that end."""
        self._task.cancel()
        try:
            await asyncio.wait([self._task])
        except asyncio.CancelledError:
            await asyncio.wait([self._task])
            raise
        bug = None if self._task.cancelled() else self._task.exception()
        if bug is not None and not isinstance(bug, CanductorError):
            raise bug

    async def _perform(self) -> Done:
        self._has_begun = True  # never, where it was ended before its turn
        return await self._event.perform() or Done()
