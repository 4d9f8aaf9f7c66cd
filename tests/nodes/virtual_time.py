"""An event loop whose time jumps to the next timer: tests of timeouts that take no time."""

import asyncio
import selectors
from collections.abc import Coroutine
from typing import Any, TypeVar

START_S = 1000.0
MAX_VIRTUAL_S = 3600.0


class _JumpingSelector(selectors.DefaultSelector):
    """Moves its loop's time on instead of waiting."""

    now_s = START_S

    def select(self, timeout: float | None = None) -> list[tuple[selectors.SelectorKey, int]]:
        events: list[tuple[selectors.SelectorKey, int]] = super().select(0)
        if events or timeout == 0:
            return events
        if timeout is None:
            raise RuntimeError("nothing will ever happen: the test waits for an event that nobody sends")
        self.now_s += max(timeout, 1e-9)
        if self.now_s > START_S + MAX_VIRTUAL_S:
            raise RuntimeError(f"still not over after {MAX_VIRTUAL_S} virtual seconds")
        return events


class VirtualLoop(asyncio.SelectorEventLoop):
    """Runs in virtual time."""

    def __init__(self) -> None:
        self.jumping = _JumpingSelector()
        super().__init__(self.jumping)

    def time(self) -> float:
        return self.jumping.now_s


T = TypeVar("T")


def run(main: Coroutine[Any, Any, T]) -> T:
    """Run MAIN in virtual time; whatever it leaves running is an error."""
    with asyncio.Runner(loop_factory=VirtualLoop) as runner:

        async def tidy() -> T:
            result = await main
            left = [task for task in asyncio.all_tasks() if task is not asyncio.current_task()]
            assert not left, f"left running: {left}"
            return result

        return runner.run(tidy())
