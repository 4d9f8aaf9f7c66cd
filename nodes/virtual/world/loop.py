"""An asyncio loop in the time of a simulated world: the world runs while the loop waits."""

import asyncio
import math
from asyncio import base_events
from collections.abc import Callable, Coroutine
from functools import partial
from typing import Any, Final, TypeVar

from nodes.support.errors import CanductorError
from nodes.support.work_thread import ThreadlessLoop
from nodes.virtual.world.world import World

T = TypeVar("T")
_NS: Final = 1_000_000_000
IDLE_LIMIT_S: Final = 60.0
"""Time without a timer or a message from outside after which the run counts as a deadlock."""


class Stuck(CanductorError):  # noqa: N818
    """Nothing can happen any more, or the limit of virtual time is exceeded."""


class _WorldSelector:
    """The selector of the loop."""

    def __init__(self, world: World, limit_s: float) -> None:
        self._world = world
        self._end_ns = world.now_ns + round(limit_s * _NS)
        self._limit_s = limit_s

    def select(self, timeout_s: float | None) -> list[Callable[[], None]]:
        """Run the world for TIMEOUT_S at most; return the handlers to be called for messages from outside."""
        world = self._world
        if timeout_s is not None and timeout_s <= 0:
            until_ns = max(world.now_ns, world.python_stalled_ns)
        else:
            until_ns = world.python_wakes_ns(self._due_ns(timeout_s))
        noticed = world.run_until(until_ns)
        if not noticed and timeout_s is None:
            raise Stuck(
                f"nothing happened for {IDLE_LIMIT_S:g} virtual seconds, and no timer runs: a deadlock"
            )
        return world.noticed()

    def _due_ns(self, timeout_s: float | None) -> int:
        now_ns = self._world.now_ns
        if now_ns > self._end_ns:
            raise Stuck(f"not finished after {self._limit_s:g} virtual seconds")
        if timeout_s is not None:
            return now_ns + max(1, math.ceil(timeout_s * _NS))
        if not self._world.listening:
            raise Stuck("nothing can happen: no timer runs and no bus is open")
        return now_ns + round(IDLE_LIMIT_S * _NS)

    def close(self) -> None:
        """Do nothing: there are no resources."""


class VirtualLoop(base_events.BaseEventLoop, ThreadlessLoop):
    """A loop whose time() is WORLD's; raises Stuck after LIMIT_S of virtual time, or when nothing can happen.

    Functions for an executor run at once and take EXECUTOR_S of virtual time. ``deliver`` sends signals.
    """

    def __init__(self, world: World, *, limit_s: float = 3600.0, executor_s: float = 0.0) -> None:
        super().__init__()
        self.world = world
        self._executor_s = executor_s
        self._selector = _WorldSelector(world, limit_s)
        self._clock_resolution = 1e-9
        self._signal_handlers: dict[int, Callable[[], object]] = {}

    def time(self) -> float:
        """Return the world's time in s."""
        return self.world.now_ns / _NS

    def run_in_executor(  # type: ignore[override]
        self, executor: object, func: Callable[..., T], *args: Any
    ) -> "asyncio.Future[T]":
        """Run FUNC now; its result comes after the executor's virtual time."""
        del executor
        future: asyncio.Future[T] = self.create_future()
        try:
            result = func(*args)
        except Exception as error:  # noqa: BLE001 - raised where the future is awaited
            self.call_later(self._executor_s, _finish, future, None, error)
        else:
            self.call_later(self._executor_s, _finish, future, result, None)
        return future

    def add_signal_handler(self, sig: int, callback: Callable[..., object], *args: Any) -> None:  # type: ignore[override]
        """Call CALLBACK on ``deliver`` of SIG."""
        self._signal_handlers[sig] = partial(callback, *args)

    def remove_signal_handler(self, sig: int) -> bool:
        """Remove the handler of SIG; return whether there was one."""
        return self._signal_handlers.pop(sig, None) is not None

    def deliver(self, sig: int) -> None:
        """Call the handler of signal SIG, as the kernel would; no effect without a handler."""
        if sig in self._signal_handlers:
            self.call_soon(self._signal_handlers[sig])

    def _process_events(self, event_list: list[Callable[[], None]]) -> None:
        for handler in event_list:
            self.call_soon(handler)

    def _write_to_self(self) -> None:
        """Do nothing: the loop never sleeps."""


def _finish(future: "asyncio.Future[Any]", result: object, error: Exception | None) -> None:
    if future.done():
        return
    if error is None:
        future.set_result(result)
    else:
        future.set_exception(error)


def run(world: World, main: Coroutine[Any, Any, T], *, limit_s: float = 3600.0, executor_s: float = 0.0) -> T:
    """Run MAIN in WORLD's time; tasks that it leaves running are an error."""
    with asyncio.Runner(
        loop_factory=lambda: VirtualLoop(world, limit_s=limit_s, executor_s=executor_s)
    ) as runner:

        async def tidy() -> T:
            result = await main
            left = [task for task in asyncio.all_tasks() if task is not asyncio.current_task()]
            assert not left, f"left running: {left}"
            return result

        return runner.run(tidy())
