"""Ctrl-C, SIGTERM and SIGHUP as the cancellation of a job, never as an exception out of the blue."""

import asyncio
import signal
from collections.abc import Callable, Coroutine
from types import TracebackType
from typing import Any, Final, Self, TypeVar

from nodes.support.termination import TERMINATION

T = TypeVar("T")
_BACKGROUND: Final = (signal.SIGTTIN, signal.SIGTTOU)
"""Stop a program that reads its terminal, or writes to it (``stty tostop``), in the background of a shell."""


class Terminated(KeyboardInterrupt):
    """NUMBER, one of TERMINATION, ended a command, as Ctrl-C does."""

    def __init__(self, number: int = signal.SIGTERM) -> None:
        super().__init__()
        self.signal: Final = signal.Signals(number)


def run_to_end(
    job: Callable[[], Coroutine[Any, Any, T]],
    make_loop: Callable[[], asyncio.AbstractEventLoop] = asyncio.new_event_loop,
) -> T:
    """Run JOB in a loop of its own; the first Ctrl-C, SIGTERM or SIGHUP cancels it, others change nothing.

    When it has ended, KeyboardInterrupt or Terminated is raised for the signal. In the background of a shell
    JOB is not stopped for what it writes to the terminal; what it reads there fails.
    """
    with _Interrupts() as interrupts:
        try:
            with asyncio.Runner(loop_factory=make_loop) as runner:
                result = runner.run(interrupts.guard(job))
        except asyncio.CancelledError:
            raise interrupts.exception() from None
    if interrupts.received:
        raise interrupts.exception()
    return result


class _Interrupts:
    """Signals are noted for as long as the block lasts; the first one cancels what ``guard`` runs.

    While the loop is made and taken down they are only noted: an exception in there would leave it half done.
    """

    def __init__(self) -> None:
        self.received: list[int] = []
        numbers = (signal.SIGINT, *TERMINATION)
        # Ctrl-C is ignored by what a shell runs in the background, SIGHUP by what nohup does, and shall be.
        self._numbers = [n for n in numbers if signal.getsignal(n) is not signal.SIG_IGN]

    def exception(self) -> KeyboardInterrupt:
        """Return what to raise for the first signal."""
        first = self.received[0]
        return Terminated(first) if first in TERMINATION else KeyboardInterrupt()

    def __enter__(self) -> Self:
        self._handlers = {number: signal.signal(number, self._note) for number in self._numbers}
        self._handlers |= {number: signal.signal(number, signal.SIG_IGN) for number in _BACKGROUND}
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for number, handler in self._handlers.items():
            signal.signal(number, handler)

    def _note(self, number: int, _: object) -> None:
        self.received.append(number)

    async def guard(self, job: Callable[[], Coroutine[Any, Any, T]]) -> T:
        """Run JOB, cancelled by the first signal."""
        loop, task = asyncio.get_running_loop(), asyncio.current_task()
        assert task is not None

        def interrupt(number: int) -> None:
            if not self.received:
                task.cancel()
            self.received.append(number)

        for number in self._numbers:
            loop.add_signal_handler(number, interrupt, number)
        if self.received:
            task.cancel()
        try:
            return await job()
        finally:
            for number in self._numbers:
                loop.remove_signal_handler(number)
                signal.signal(number, self._note)
