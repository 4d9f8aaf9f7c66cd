"""The watchdog of the control loop: what it does while the loop is held, and what it reports of that."""

import asyncio
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress

import pytest

from coordinator.support.loop_watchdog import HELD_S, TURN_S, LoopWatchdog, WatchedLoop

PATIENCE_S = 60.0


class Watched:
    """A loop that is held until the watchdog has looked at it twice since it had to report that."""

    def __init__(self) -> None:
        self.reports: list[str] = []
        self.threads: set[int] = set()
        self.looks: Callable[[], None] = lambda: None
        self.is_held: Callable[[], bool]
        self._since_s = 0.0
        self._late_looks = 0
        self._over = threading.Event()
        self.events_fd = os.eventfd(0)
        self.handled = threading.Event()
        self.fails = False

    def hold_the_loop(self) -> None:
        self._since_s, self._late_looks = time.monotonic(), 0
        self._over.clear()
        assert self._over.wait(PATIENCE_S)

    def while_held(self, is_held: Callable[[], bool]) -> None:
        assert is_held()
        self.is_held = is_held
        self.threads.add(threading.get_ident())
        self.looks()
        self._late_looks += time.monotonic() - self._since_s > HELD_S
        if self._late_looks > 2:
            self._over.set()

    def on_events(self) -> None:
        os.eventfd_read(self.events_fd)
        self.threads.add(threading.get_ident())
        if self.fails:
            self.fails = False
            raise RuntimeError("shown")
        self.handled.set()

    async def main(self, *actions: Callable[[], None]) -> None:
        loop = asyncio.get_running_loop()
        assert isinstance(loop, WatchedLoop)
        watchdog = LoopWatchdog(loop, self.reports.append, self.while_held, self.events_fd, self.on_events)
        watchdog.start()
        try:
            for act in actions:
                loop.call_soon(act)
                await asyncio.sleep(0)
                await asyncio.sleep(0)
                await asyncio.sleep(0)
        finally:
            watchdog.close()

    def run(self, *actions: Callable[[], None]) -> None:
        with asyncio.Runner(loop_factory=WatchedLoop) as runner:
            runner.run(self.main(*actions))
        os.close(self.events_fd)


def test_who_holds_the_loop_is_named_and_others_are_counted() -> None:
    watched = Watched()
    watched.run(watched.hold_the_loop, watched.hold_the_loop)
    (report,) = watched.reports
    assert report.startswith("the control loop was held for ")
    assert "hold_the_loop (support/test_loop_watchdog.py:" in report
    assert "asyncio/" not in report
    assert "main (" not in report, "nor who runs the loop"
    assert "it calculated for " in report
    assert threading.get_ident() not in watched.threads


def test_a_hold_is_over_when_the_loop_goes_on() -> None:
    watched, held = Watched(), list[bool]()
    watched.run(watched.hold_the_loop, lambda: held.append(watched.is_held()))
    assert held == [False]


def test_events_are_handled_whatever_the_loop_does(capsys: pytest.CaptureFixture[str]) -> None:
    """In the thread: new connections do not wait for the rounds of a busy loop."""
    watched = Watched()

    def signal_events() -> None:
        watched.fails = True
        for _ in range(2):
            os.eventfd_write(watched.events_fd, 1)
            while watched.fails:  # a failure is shown, and ends nothing
                time.sleep(0)
        assert watched.handled.wait(PATIENCE_S)

    watched.run(signal_events)
    assert watched.threads.isdisjoint({threading.get_ident()})
    assert "RuntimeError: shown" in capsys.readouterr().err


def test_a_loop_that_calculates_gives_the_thread_its_turns() -> None:
    """Failed before: each call of the system cost the thread 5 ms, and it makes one for each client."""
    watched, intervals_s = Watched(), set[float]()
    usual_s = sys.getswitchinterval()
    watched.run(lambda: intervals_s.add(sys.getswitchinterval()))  # before the thread's first turn, too
    assert max(intervals_s) == pytest.approx(TURN_S)
    assert sys.getswitchinterval() == usual_s, "the rest of the program keeps its own"


def test_signals_that_wait_are_seen_while_the_loop_is_held() -> None:
    watched, came, seen = Watched(), list[int](), list[int]()

    def hold() -> None:
        signal.raise_signal(signal.SIGUSR1)
        watched.hold_the_loop()

    def begin() -> None:
        loop = asyncio.get_running_loop()
        assert isinstance(loop, WatchedLoop)
        loop.add_signal_handler(signal.SIGUSR1, lambda: came.append(len(seen)))
        watched.looks = lambda: seen.extend(loop.pending_signals())

    watched.run(begin, hold)
    assert set(seen) == {signal.SIGUSR1}
    assert came, "the loop has it, too"
    assert came[0] > 0, "and later"


@contextmanager
def unread_errors() -> Iterator[None]:
    """Let standard error be a pipe that is full."""
    reads, writes = os.pipe()
    os.set_blocking(writes, False)
    with suppress(BlockingIOError):
        while True:
            os.write(writes, bytes(4096))
    os.set_blocking(writes, True)
    usual = os.dup(2)
    os.dup2(writes, 2)
    with os.fdopen(writes, "w", encoding="utf-8") as stream:
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(sys, "stderr", stream)
            yield
        os.dup2(usual, 2)
        os.close(usual)
        os.close(reads)


def test_the_thread_does_not_wait_for_who_reads_its_errors() -> None:
    watched, looks = Watched(), iter((True,))

    def look() -> None:
        if next(looks, False):
            raise RuntimeError("shown")

    watched.looks = look
    with unread_errors():
        watched.run(watched.hold_the_loop)
    assert len(watched.reports) == 1
