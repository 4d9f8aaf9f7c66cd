"""Threads that block, in virtual time: one of them runs at a time, and time jumps when all wait.

For code that reads a clock and waits at a port in the thread of who calls it. The test's own thread is one of
them: while it does not wait, nobody else runs and no time passes.
"""

import math
import threading
from collections.abc import Callable
from typing import Generic, TypeVar

T = TypeVar("T")


class Stuck(AssertionError):  # noqa: N818
    """All threads wait for each other."""


class Lockstep:
    """The time that the threads share; who makes it is the first one, and runs."""

    def __init__(self) -> None:
        self.now_s = 0.0
        self._lock = threading.Lock()
        self._waiting: dict[threading.Semaphore, Callable[[], float]] = {}  # in the order of their coming
        self._stuck = False

    def wait(self, wakes_s: Callable[[], float]) -> None:
        """Let others run until the time that WAKES_S returns; it is asked again whenever somebody waits.

        Raises Stuck.
        """
        turn = threading.Semaphore(0)
        with self._lock:
            self._waiting[turn] = wakes_s
            self._pass_on()
        turn.acquire()
        if self._stuck:
            raise Stuck("nobody will ever go on")

    def sleep(self, seconds: float) -> None:
        """Let others run for so long."""
        until_s = self.now_s + seconds
        self.wait(lambda: until_s)

    def start(self, work: Callable[[], T]) -> "Thread[T]":
        """Have WORK done by a thread of its own, which begins when all others wait."""
        return Thread(self, work)

    def leave(self) -> None:
        """Let others run for good: this thread ends."""
        with self._lock:
            self._pass_on()

    def _pass_on(self) -> None:
        """Wake who wakes first; of those who wake together, who has waited longest."""
        if not self._waiting:
            return
        times = {turn: max(self.now_s, wakes_s()) for turn, wakes_s in self._waiting.items()}
        turn = min(times, key=times.__getitem__)
        self._stuck = self._stuck or math.isinf(times[turn])
        if not self._stuck:
            self.now_s = times[turn]
        del self._waiting[turn]
        turn.release()


class Thread(Generic[T]):
    """A thread in lockstep, and what became of its work."""

    def __init__(self, lockstep: Lockstep, work: Callable[[], T]) -> None:
        self._lockstep = lockstep
        self._work = work
        self._results: list[T] = []
        self._errors: list[BaseException] = []
        self._over = False
        begun = threading.Semaphore(0)
        self._thread = threading.Thread(target=self._run, args=(begun,), daemon=True)
        self._thread.start()
        begun.acquire()

    def _run(self, begun: threading.Semaphore) -> None:
        turn = threading.Semaphore(0)
        with self._lockstep._lock:
            self._lockstep._waiting[turn] = lambda: 0.0
        begun.release()
        turn.acquire()
        try:
            self._results.append(self._work())
        except BaseException as error:  # noqa: BLE001 (raised in the thread that joins)
            self._errors.append(error)
        self._over = True
        self._lockstep.leave()

    def join(self) -> T:
        """Wait for its end; return its result, or raise what it raised."""
        if not self._over:
            self._lockstep.wait(lambda: 0.0 if self._over else math.inf)
        self._thread.join()
        for error in self._errors:
            raise error
        return self._results[0]
