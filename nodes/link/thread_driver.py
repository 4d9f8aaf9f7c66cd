"""The driver of a real bus: its I/O thread (io_thread.h)."""

import asyncio
import os
from collections.abc import Callable
from typing import Any

from nodes.link._link import ffi as _ffi
from nodes.link._link import lib as _lib
from nodes.link.types import BusSettings, LinkError, LinkTransport, TransportKind
from nodes.support.awake import WakingLoop


class ThreadDriver:
    """Runs TRANSPORT, which stays the caller's, in a thread of its own; notifies LOOP of what arrives."""

    def __init__(
        self, transport: LinkTransport, loop: asyncio.AbstractEventLoop, settings: BusSettings
    ) -> None:
        self.name = transport.name
        self.serial = transport.kind == TransportKind.BYTES
        self.ffi = _ffi
        self.lib = _lib
        self._loop = loop
        self._look_no_more: Callable[[], None] = _nothing
        os.set_blocking(transport.fileno(), False)
        line = _ffi.new("struct io_settings *", settings.as_dict())
        self._thread: Any = _lib.io_start(transport.fileno(), int(transport.kind), line)
        if self._thread == _ffi.NULL:
            raise LinkError(f"{self.name}: cannot start the I/O thread; out of memory or threads")
        self.bus: Any = _lib.io_thread_bus(self._thread)
        self._notice_fd: int = _lib.io_notice_fd(self._thread)

    def listen(self, handler: Callable[[], None]) -> None:
        """Call HANDLER in the loop's thread when io_take() has something.

        What may wait is also taken when a timer or another bus has woken the loop, if the loop says so.
        """
        self._loop.add_reader(self._notice_fd, handler)

        def look() -> None:
            if _lib.io_waits(self.bus):
                self._loop.call_soon(handler)

        if isinstance(self._loop, WakingLoop):
            self._look_no_more = self._loop.when_awake(look, also_by=self._notice_fd)

    def close(self) -> None:
        """Join the thread and free the bus."""
        self._look_no_more()
        self._loop.remove_reader(self._notice_fd)
        _lib.io_stop(self._thread)


def _nothing() -> None:
    """Do nothing."""
