"""An asyncio loop with real sockets and virtual time, for servers and clients in one process.

Time passes only when everybody waits: then it jumps to the next timer. So a server's time limits are tested
with the values it ships with, without waiting, and a computer that is busy or stands still makes no
difference.

It is for one process and one thread: nothing else may be waited for. What is given to an executor is done at
once. Sockets may be of any kind. Before each jump a byte is sent through a TCP connection of the loop's own
and back: the kernel delivers what is sent over the loopback in order, so all that was sent has arrived then.
"""

import asyncio
import selectors
import socket
from collections.abc import Callable, Coroutine, Mapping
from typing import Any, Final, TypeVar

from nodes.support.work_thread import ThreadlessLoop

T = TypeVar("T")
LIMIT_S: Final = 3_600.0
"""Virtual time that a test may take."""
ROUNDS: Final = 3
"""Times the byte is sent each way: some segments (SYN) are answered with others, which queue behind it."""


class Stuck(AssertionError):  # noqa: N818
    """Nothing will ever happen any more, or not within the virtual time that was allowed."""


class _Barrier:
    """A TCP connection of the loopback, to wait until the kernel has delivered what was sent before."""

    def __init__(self) -> None:
        with socket.create_server(("127.0.0.1", 0)) as listener:
            self._near = socket.create_connection(listener.getsockname())
            self._far, _ = listener.accept()
        for end in (self._near, self._far):
            end.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)

    def wait(self) -> None:
        for _ in range(ROUNDS):
            self._near.sendall(b"x")
            self._far.recv(1)
            self._far.sendall(b"x")
            self._near.recv(1)

    def close(self) -> None:
        self._near.close()
        self._far.close()


class _JumpSelector(selectors.BaseSelector):
    """What the loop calls to wait; instead of waiting it lets the time jump."""

    def __init__(self) -> None:
        self._real = selectors.DefaultSelector()
        self._barrier = _Barrier()
        self.now_s = 0.0

    def select(self, timeout: float | None = None) -> list[tuple[selectors.SelectorKey, int]]:
        events = self._real.select(0)
        if events or (timeout is not None and timeout <= 0):
            return events
        self._barrier.wait()
        events = self._real.select(0)
        if events:
            return events
        if timeout is None:
            raise Stuck("nothing will ever happen: no timer runs, and nobody sends")
        self.now_s += timeout
        if self.now_s > LIMIT_S:
            raise Stuck(f"still not over after {LIMIT_S:g} virtual seconds")
        return []

    def register(self, fileobj: Any, events: int, data: Any = None) -> selectors.SelectorKey:
        return self._real.register(fileobj, events, data)

    def unregister(self, fileobj: Any) -> selectors.SelectorKey:
        return self._real.unregister(fileobj)

    def modify(self, fileobj: Any, events: int, data: Any = None) -> selectors.SelectorKey:
        return self._real.modify(fileobj, events, data)

    def get_map(self) -> Mapping[Any, selectors.SelectorKey]:
        return self._real.get_map()

    def close(self) -> None:
        self._real.close()
        self._barrier.close()


class JumpLoop(asyncio.SelectorEventLoop, ThreadlessLoop):
    """The loop; its time() begins at 0.

    Nothing takes time but waiting, and each look at the clock, by whoever, LOOK_S: with more than 0 the
    computer is a slow one.
    """

    def __init__(self, look_s: float = 0.0) -> None:
        self._jumps = _JumpSelector()
        self._look_s = look_s
        super().__init__(self._jumps)

    def time(self) -> float:
        """Return the virtual time in s."""
        self._jumps.now_s += self._look_s
        return self._jumps.now_s

    def run_in_executor(  # type: ignore[override]
        self, executor: object, func: Callable[..., T], *args: Any
    ) -> "asyncio.Future[T]":
        """Run FUNC now."""
        del executor
        future: asyncio.Future[T] = self.create_future()
        try:
            future.set_result(func(*args))
        except Exception as error:  # noqa: BLE001 (whatever it is belongs to who awaits the future)
            future.set_exception(error)
        return future


def run(main: Coroutine[Any, Any, T], *, look_s: float = 0.0) -> T:
    """Run MAIN in virtual time; raises Stuck."""
    with asyncio.Runner(loop_factory=lambda: JumpLoop(look_s)) as runner:
        return runner.run(main)
