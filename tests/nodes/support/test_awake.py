"""What has time, on a loop that does not say when it is awake: it comes at the earlier time."""

import asyncio

import pytest

from nodes.support.awake import call_between, sleep_between
from tests.nodes import virtual_time


def test_it_comes_at_the_earlier_time_unless_it_is_cancelled() -> None:
    came_s: list[float] = []

    async def main() -> None:
        loop = asyncio.get_running_loop()
        begun_s = loop.time()

        def come() -> None:
            came_s.append(loop.time() - begun_s)

        call_between(begun_s + 1.0, begun_s + 2.0, come)
        cancel = call_between(begun_s + 1.5, begun_s + 3.0, come)
        await asyncio.sleep(1.2)
        cancel()
        await sleep_between(3.0, 4.0)
        come()

    virtual_time.run(main())
    assert came_s == pytest.approx([1.0, 4.2], abs=1e-6)


def test_a_sleep_that_is_cancelled_leaves_nothing_behind() -> None:
    async def main() -> None:
        sleeping = asyncio.ensure_future(sleep_between(1.0, 2.0))
        await asyncio.sleep(0.5)
        sleeping.cancel()
        with pytest.raises(asyncio.CancelledError):
            await sleeping
        await asyncio.sleep(2.0)

    virtual_time.run(main())


def test_a_sleeper_that_is_cancelled_when_its_time_has_come_is_only_cancelled() -> None:
    failures: list[object] = []

    async def main() -> bool:
        loop = asyncio.get_running_loop()
        loop.set_exception_handler(lambda _, context: failures.append(context))
        sleeping = asyncio.ensure_future(sleep_between(1.0, 1.0))
        loop.call_at(loop.time() + 1.0, sleeping.cancel)
        await asyncio.wait([sleeping])
        return sleeping.cancelled()

    assert virtual_time.run(main())
    assert failures == []
