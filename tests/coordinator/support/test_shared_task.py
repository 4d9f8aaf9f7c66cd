"""Who waits for a shared result may leave, whatever becomes of it."""

import asyncio
import gc
from typing import Any

import pytest

from coordinator.support.shared_task import shared_task


async def fail(after: asyncio.Event) -> int:
    await after.wait()
    raise ValueError("it failed")


def test_a_failure_that_nobody_waits_for_is_not_reported() -> None:
    reported: list[dict[str, Any]] = []

    async def leave() -> None:
        asyncio.get_running_loop().set_exception_handler(lambda _, context: reported.append(context))
        may_end = asyncio.Event()
        task = shared_task(fail(may_end))
        waiter = asyncio.ensure_future(asyncio.shield(task))
        await asyncio.sleep(0)
        waiter.cancel()
        may_end.set()
        await asyncio.wait((task, waiter))
        assert task.done()

    asyncio.run(leave())
    gc.collect()
    assert reported == []


def test_who_waits_gets_it() -> None:
    async def wait() -> None:
        may_end = asyncio.Event()
        task = shared_task(fail(may_end))
        may_end.set()
        for _ in range(2):
            with pytest.raises(ValueError, match="it failed"):
                await asyncio.shield(task)

    asyncio.run(wait())
