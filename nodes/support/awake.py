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


async def sleep_between(least_s: float, most_s: float) -> None:
    """Sleep for LEAST_S, and until the loop is awake anyway, MOST_S at most; see ``call_between``."""
    loop = asyncio.get_running_loop()
    over = loop.create_future()
    now_s = loop.time()

    def wake() -> None:
        if not over.done():  # the task may have been cancelled in this iteration of the loop
            over.set_result(None)

    cancel = call_between(now_s + least_s, now_s + most_s, wake)
    try:
        await over
    finally:
        cancel()
