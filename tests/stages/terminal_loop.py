"""A loop in virtual time that also serves file descriptors and signals, for programs that read a terminal."""

import select
import signal
from collections.abc import Callable
from functools import partial
from typing import Any

from nodes.virtual.world import VirtualLoop, World


class _InputFirst:
    """What the base loop calls to wait: what can be read comes before any virtual time passes."""

    def __init__(self, inner: Any, readers: dict[int, Callable[[], None]]) -> None:
        self._inner = inner
        self._readers = readers

    def select(self, timeout_s: float | None) -> list[Callable[[], None]]:
        ready, _, _ = select.select(list(self._readers), [], [], 0)
        if ready:
            return [self._readers[fd] for fd in ready]
        found: list[Callable[[], None]] = self._inner.select(timeout_s)
        return found

    def close(self) -> None:
        self._inner.close()


class TerminalLoop(VirtualLoop):
    """A VirtualLoop with add_reader() and add_signal_handler(); for the main thread."""

    def __init__(self, world: World) -> None:
        super().__init__(world)
        self._readers: dict[int, Callable[[], None]] = {}
        self._selector: Any = _InputFirst(self._selector, self._readers)
        self._signals: dict[int, Any] = {}

    def add_reader(self, fd: Any, callback: Callable[..., Any], *args: Any) -> None:  # type: ignore[override]
        """Call CALLBACK whenever FD can be read."""
        self._readers[_number(fd)] = partial(callback, *args)

    def remove_reader(self, fd: Any) -> bool:
        """End ``add_reader``."""
        return self._readers.pop(_number(fd), None) is not None

    def add_signal_handler(  # type: ignore[override]
        self, sig: int, callback: Callable[..., Any], *args: Any
    ) -> None:
        """Call CALLBACK in the loop when a signal came."""
        before = signal.signal(sig, lambda *_: self.call_soon(callback, *args))
        self._signals.setdefault(sig, before)

    def remove_signal_handler(self, sig: int) -> bool:
        """End ``add_signal_handler``."""
        if sig not in self._signals:
            return False
        signal.signal(sig, self._signals.pop(sig))
        return True


def _number(fd: Any) -> int:
    return fd if isinstance(fd, int) else int(fd.fileno())
