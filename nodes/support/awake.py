"""Timers with slack: what has time until an event loop is awake anyway, which is woken once for all then."""

import asyncio
from abc import ABC, abstractmethod
from collections.abc import Callable


class WakingLoop(ABC):
    """An event loop that says when it is awake."""

    @abstractmethod
    def when_awake(self, call: Callable[[], None], *, also_by: int | None = None) -> Callable[[], None]:
        """Call CALL whenever the loop has woken up and nobody waits for it; return what ends that.

        Events of the descriptor ALSO_BY count as such: what they bring is handled before CALL's work.
        """

    @abstractmethod
    def call_between(
        self, earliest_s: float, latest_s: float, call: Callable[[], None]
    ) -> Callable[[], None]:
        """Call CALL once, when the loop is awake anyway between two of its times, else at the later one.

        Return what cancels it.
        """


def call_between(earliest_s: float, latest_s: float, call: Callable[[], None]) -> Callable[[], None]:
    """Do the same with the running loop; one that does not say when it is awake calls at the earlier time."""
    loop = asyncio.get_running_loop()
    if isinstance(loop, WakingLoop):
        return loop.call_between(earliest_s, latest_s, call)
    return loop.call_at(earliest_s, call).cancel


class Pause:
    """A sleep that ends when the loop is awake anyway (see ``call_between``), or by ``end``."""

    def __init__(self) -> None:
        self._over: asyncio.Future[None] | None = None
        """Of who sleeps."""

    async def between(self, earliest_s: float, latest_s: float) -> None:
        """Sleep until the loop is awake between two of its times, the later one at most."""
        over = self._over = asyncio.get_running_loop().create_future()
        cancel = call_between(earliest_s, latest_s, self.end)
        try:
            await over
        finally:
            cancel()
            self._over = None

    def end(self) -> None:
        """End it now; without effect when nobody sleeps."""
        if self._over is not None and not self._over.done():
            self._over.set_result(None)


async def sleep_between(least_s: float, most_s: float) -> None:
    """Sleep for LEAST_S, and until the loop is awake anyway, MOST_S at most; see ``call_between``."""
    now_s = asyncio.get_running_loop().time()
    await Pause().between(now_s + least_s, now_s + most_s)
