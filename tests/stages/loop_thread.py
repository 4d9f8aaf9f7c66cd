"""A server on an asyncio loop in a thread of its own, for tests whose own thread has to do something else."""

import asyncio
import threading
from collections.abc import Callable, Iterator
from contextlib import AbstractAsyncContextManager, contextmanager
from typing import TypeVar

T = TypeVar("T")
LAST_ROUNDS = 10
"""Of the loop: asyncio takes some from accepting a connection to seeing that its client has left again."""


@contextmanager
def in_thread(serve: Callable[[], AbstractAsyncContextManager[T]]) -> Iterator[T]:
    """Enter what SERVE makes on a loop in another thread, and leave it there at the end."""
    ready = threading.Event()
    entered: list[T] = []
    stopping: list[tuple[asyncio.AbstractEventLoop, asyncio.Event]] = []
    failed: list[BaseException] = []

    async def main() -> None:
        stop = asyncio.Event()
        stopping.append((asyncio.get_running_loop(), stop))
        async with serve() as served:
            entered.append(served)
            ready.set()
            await stop.wait()
        for _ in range(LAST_ROUNDS):
            await asyncio.sleep(0)

    def run() -> None:
        try:
            asyncio.run(main())
        except BaseException as error:  # noqa: BLE001 (raised in the test's thread)
            failed.append(error)
        finally:
            ready.set()

    thread = threading.Thread(target=run)
    thread.start()
    ready.wait()
    try:
        if entered:
            yield entered[0]
    finally:
        for loop, stop in stopping:
            if thread.is_alive():
                loop.call_soon_threadsafe(stop.set)
        thread.join()
    if failed:
        raise failed[0]
