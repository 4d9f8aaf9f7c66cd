"""A thread that works for a loop: what it returns and raises, in which thread, and how it ends."""

import asyncio
import threading

import pytest

from nodes.support.errors import CanductorError
from nodes.support.work_thread import WorkThread
from tests.stages import jump_loop


def test_all_work_is_done_in_one_thread_which_ends_with_the_block() -> None:
    async def main() -> tuple[threading.Thread, list[threading.Thread]]:
        async with WorkThread("motion") as thread:
            done_in = [await thread.run(threading.current_thread) for _ in range(3)]
            assert await thread.run(divmod, 7, 4) == (1, 3)
        return threading.current_thread(), done_in

    loop_thread, done_in = asyncio.run(main())
    (worker,) = set(done_in)
    assert worker is not loop_thread
    assert worker.name == "motion"
    assert not worker.is_alive()


def test_what_the_work_raises_is_raised_and_the_thread_goes_on() -> None:
    def fail() -> None:
        raise CanductorError("it was in vain")

    async def main() -> int:
        async with WorkThread("motion") as thread:
            with pytest.raises(CanductorError, match="it was in vain"):
                await thread.run(fail)
            return await thread.run(abs, -4)

    assert asyncio.run(main()) == 4


def test_an_exception_that_no_future_carries_hangs_nobody() -> None:
    async def main() -> None:
        failure = pytest.raises(RuntimeError, match="motion: StopIteration was not caught")
        async with WorkThread("motion") as thread:
            with failure:
                await thread.run(next, iter(()))

    asyncio.run(main())


class Held:
    """Work that goes on until the test lets it end."""

    def __init__(self) -> None:
        self.begun, self.go_on = threading.Event(), threading.Event()
        self.finished = False

    def __call__(self) -> None:
        self.begun.set()
        self.go_on.wait()
        self.finished = True


def test_a_block_that_is_left_waits_for_work_that_was_begun() -> None:
    work = Held()

    async def main() -> None:
        async with WorkThread("motion") as thread:
            waiting = asyncio.ensure_future(thread.run(work))
            await asyncio.to_thread(work.begun.wait)
            waiting.cancel()
            with pytest.raises(asyncio.CancelledError):
                await waiting
            work.go_on.set()
        assert work.finished

    asyncio.run(main())


def test_the_loop_goes_on_while_the_end_of_the_work_is_waited_for() -> None:
    """Failed before: the loop was blocked until then, also by a work that only the loop could end."""
    work = Held()

    async def block() -> None:
        async with WorkThread("motion") as thread:
            await thread.run(work)

    async def main() -> None:
        leaving = asyncio.ensure_future(block())
        await asyncio.to_thread(work.begun.wait)
        for _ in range(3):  # also one that is cancelled again leaves no work behind
            leaving.cancel()
            await asyncio.sleep(0)
        assert not leaving.done()
        work.go_on.set()
        with pytest.raises(asyncio.CancelledError):
            await leaving
        assert work.finished

    asyncio.run(main())


def test_without_work_there_is_no_thread() -> None:
    async def main() -> None:
        before = threading.active_count()
        async with WorkThread("motion"):
            assert threading.active_count() == before

    asyncio.run(main())


def test_a_loop_without_threads_does_it_itself() -> None:
    async def main() -> None:
        async with WorkThread("motion") as thread:
            assert await thread.run(threading.current_thread) is threading.current_thread()
            with pytest.raises(ZeroDivisionError):
                await thread.run(divmod, 1, 0)

    jump_loop.run(main())
