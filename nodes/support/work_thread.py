"""A thread that works for an event loop, one call at a time."""

import asyncio
import threading
from abc import ABC, abstractmethod
from collections.abc import Callable
from queue import SimpleQueue
from types import TracebackType
from typing import Any, Final, Self, TypeVar, TypeVarTuple

T = TypeVar("T")
Ts = TypeVarTuple("Ts")
_Work = tuple[Callable[..., Any], tuple[Any, ...], "asyncio.Future[Any]"]


class ThreadlessLoop(ABC):
    """An event loop in whose time there are no threads: what is meant for one is called on the loop."""

    @abstractmethod
    def run_in_executor(self, executor: object, func: Callable[[*Ts], T], *args: *Ts) -> "asyncio.Future[T]":
        """Call FUNC with ARGS; its result comes when that has taken its time."""


class WorkThread:
    """The thread NAME, from its first work for the running loop to the end of an ``async with`` block.

    A ThreadPoolExecutor's futures are made for waiters in any thread; here only the loop waits, and it rests
    right after a hand-over, so that the two do not fight for the interpreter lock.
    """

    def __init__(self, name: str) -> None:
        self._name: Final = name
        self._loop = asyncio.get_running_loop()
        self._threadless = self._loop if isinstance(self._loop, ThreadlessLoop) else None
        self._waiting: SimpleQueue[_Work | None] = SimpleQueue()
        self._thread: threading.Thread | None = None
        self._ended: Final[asyncio.Future[None]] = self._loop.create_future()

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Wait for the thread's end, also when cancelled meanwhile: nothing of it goes on afterwards."""
        if self._thread is None:
            return
        self._waiting.put(None)
        cancelled: asyncio.CancelledError | None = None
        while not self._ended.done():
            try:
                await asyncio.wait((self._ended,))
            except asyncio.CancelledError as again:
                cancelled = again
        self._thread.join()  # it has nothing left to do
        if cancelled is not None:
            raise cancelled

    async def run(self, call: Callable[[*Ts], T], *args: *Ts) -> T:
        """Return what CALL returns in the thread, or raise what it raises.

        Work that was begun goes on when nobody waits for it any more.
        """
        if self._threadless is not None:
            return await self._threadless.run_in_executor(None, call, *args)
        if self._thread is None:
            self._thread = threading.Thread(target=self._run, name=self._name)
            self._thread.start()
        done: asyncio.Future[T] = self._loop.create_future()
        self._waiting.put((call, args, done))
        return await done

    def _run(self) -> None:
        while (work := self._waiting.get()) is not None:
            call, args, done = work
            result: Any = None
            failure: BaseException | None = None
            try:
                result = call(*args)
            except StopIteration as error:  # a future cannot carry it
                failure = RuntimeError(f"{self._name}: StopIteration was not caught")
                failure.__cause__ = error
            except BaseException as error:  # noqa: BLE001 (it belongs to who waits)
                failure = error
            self._loop.call_soon_threadsafe(_settle, done, result, failure)
            del work, call, args, done, result, failure  # nothing is kept until the next work comes
        self._loop.call_soon_threadsafe(self._ended.set_result, None)


def _settle(done: "asyncio.Future[Any]", result: object, failure: BaseException | None) -> None:
    if done.done():  # nobody waits any more
        return
    if failure is None:
        done.set_result(result)
    else:
        done.set_exception(failure)
