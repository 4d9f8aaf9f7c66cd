"""The control loop says when it is awake, and what has time is done then."""

import asyncio
import os
from collections.abc import Callable, Coroutine

import pytest

from coordinator.support.loop_watchdog import WatchedLoop
from nodes.support.awake import call_between, sleep_between

NEVER_S = 3600.0


def run(test: Callable[[WatchedLoop], Coroutine[object, object, None]]) -> None:
    async def main() -> None:
        loop = asyncio.get_running_loop()
        assert isinstance(loop, WatchedLoop)
        await test(loop)

    with asyncio.Runner(loop_factory=WatchedLoop) as runner:
        runner.run(main())


def test_who_asked_is_called_when_the_loop_wakes() -> None:
    async def test(loop: WatchedLoop) -> None:
        done: list[str] = []

        def look() -> None:
            loop.call_soon(done.append, "what was waiting")

        end = loop.when_awake(look)
        for _ in range(3):
            await asyncio.sleep(0)
        assert done == [], "it did not rest"
        loop.call_later(0.001, done.append, "what woke it")
        await asyncio.sleep(0.002)
        assert done[:2] == ["what was waiting", "what woke it"]
        end()
        done.clear()
        await asyncio.sleep(0.001)
        assert done == []

    run(test)


def test_who_has_sent_something_does_not_wait_for_what_has_time() -> None:
    async def test(loop: WatchedLoop) -> None:
        done: list[str] = []
        came = asyncio.Event()
        reads, writes = os.pipe()
        loop.add_reader(reads, came.set)
        call_between(loop.time(), loop.time() + NEVER_S, lambda: done.append("it may"))
        os.write(writes, b"?")
        await came.wait()
        loop.remove_reader(reads)
        os.close(reads)
        os.close(writes)
        assert done == []
        await asyncio.sleep(0.001)
        assert done == ["it may"]

    run(test)


def test_what_has_time_does_not_wait_for_ever_for_those_who_send() -> None:
    async def test(loop: WatchedLoop) -> None:
        came = asyncio.Event()
        reads, writes = os.pipe()
        loop.add_reader(reads, lambda: None)  # there is always something to read
        os.write(writes, b"?")
        begun_s = loop.time()
        call_between(begun_s, begun_s + 0.005, came.set)
        await came.wait()
        assert loop.time() - begun_s >= 0.005
        loop.remove_reader(reads)
        os.close(reads)
        os.close(writes)

    run(test)


def test_what_nobody_waits_for_takes_along_what_has_time() -> None:
    async def test(loop: WatchedLoop) -> None:
        done: list[str] = []
        pipes = [os.pipe() for _ in range(2)]
        came = [asyncio.Event() for _ in pipes]

        def read(number: int) -> None:
            os.read(pipes[number][0], 1)
            done.append(f"pipe {number}")
            came[number].set()

        async def write(*numbers: int) -> None:
            for number in numbers:
                os.write(pipes[number][1], b"?")
            for number in numbers:
                await came[number].wait()
                came[number].clear()
            await asyncio.sleep(0)

        for number, (reads, _) in enumerate(pipes):
            loop.add_reader(reads, read, number)
        end = loop.when_awake(lambda: None, also_by=pipes[0][0])
        call_between(loop.time(), loop.time() + NEVER_S, lambda: done.append("it may"))
        await write(0, 1)
        assert sorted(done) == ["pipe 0", "pipe 1"], "somebody else waits"
        await write(0)
        assert done[2:] == ["pipe 0", "it may"], "after what has come"
        end()
        call_between(loop.time(), loop.time() + NEVER_S, lambda: done.append("it may not"))
        await write(0)
        assert done[4:] == ["pipe 0"]
        for reads, writes in pipes:
            loop.remove_reader(reads)
            os.close(reads)
            os.close(writes)

    run(test)


def test_what_has_time_is_done_once_when_the_loop_is_awake() -> None:
    async def test(loop: WatchedLoop) -> None:
        done: list[str] = []
        now_s = loop.time()
        call_between(now_s, now_s + NEVER_S, lambda: done.append("it may"))
        call_between(now_s + NEVER_S, now_s + NEVER_S, lambda: done.append("too early"))
        for _ in range(3):
            await asyncio.sleep(0.001)
        assert done == ["it may"]
        now_s = loop.time()
        call_between(now_s, now_s + 0.02, lambda: done.append("only once"))
        await asyncio.sleep(0.001)
        await asyncio.sleep(0.04)
        assert done == ["it may", "only once"]

    run(test)


def test_what_has_time_wakes_the_loop_at_the_latest() -> None:
    async def test(loop: WatchedLoop) -> None:
        came = asyncio.Event()
        begun_s = loop.time()
        call_between(begun_s + 0.001, begun_s + 0.002, came.set)
        async with asyncio.timeout(NEVER_S):
            await came.wait()
        assert loop.time() - begun_s >= 0.001
        begun_s = loop.time()
        await sleep_between(0.001, 0.002)
        assert loop.time() - begun_s >= 0.001
        assert loop._flexible == []

    run(test)


def test_the_later_time_needs_no_rest() -> None:
    """A loop that always has something to do never rests; who has time is called at the later time."""

    async def test(loop: WatchedLoop) -> None:
        came, done = asyncio.Event(), list[str]()
        begun_s = loop.time()
        call_between(begun_s, begun_s + 0.005, came.set)
        call_between(begun_s, begun_s + NEVER_S, lambda: done.append("it may"))

        def keep_busy() -> None:
            if not came.is_set():
                loop.call_soon(keep_busy)

        keep_busy()
        await came.wait()
        assert loop.time() - begun_s >= 0.005
        assert done == []
        await asyncio.sleep(0.001)
        assert done == ["it may"]
        assert loop._flexible == []

    run(test)


def test_what_is_cancelled_is_not_done_not_even_in_the_same_turn() -> None:
    async def test(loop: WatchedLoop) -> None:
        done: list[str] = []
        now_s = loop.time()
        cancel = call_between(now_s, now_s + NEVER_S, lambda: done.append("cancelled before"))
        cancel()
        ends: list[Callable[[], None]] = []

        def cancel_the_next() -> None:
            ends[0]()

        call_between(now_s, now_s + NEVER_S, cancel_the_next)
        ends.append(call_between(now_s, now_s + NEVER_S, lambda: done.append("cancelled by the other")))
        await asyncio.sleep(0.001)
        cancel_the_next()
        assert done == []
        assert loop._flexible == []

        sleeping = asyncio.ensure_future(sleep_between(0.0, NEVER_S))
        await asyncio.sleep(0)
        loop.call_soon(sleeping.cancel)
        with pytest.raises(asyncio.CancelledError):
            await sleeping
        assert loop._flexible == []

    run(test)
