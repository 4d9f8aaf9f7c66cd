"""What a bus and its links share: the C thread's handle, and the words for its refusals."""

from typing import Any

from nodes.link._link import ffi, lib
from nodes.link.types import LinkError


class BusHandle:
    """Owns the C side of one bus. NAME is the transport's, for messages."""

    def __init__(self, name: str, fd: int, kind: int) -> None:
        self.name = name
        self.ended: str | None = None
        """One sentence, once the transport has ended by itself."""
        self._bus: Any = lib.io_start(fd, kind)
        if self._bus == ffi.NULL:
            raise LinkError(f"{name}: cannot start the I/O thread; out of memory or threads")

    @property
    def open(self) -> bool:
        """Whether close() was not called yet."""
        return self._bus is not None

    def live(self) -> Any:
        """Return the ``struct io_bus *``; raises LinkError after close()."""
        if self._bus is None:
            raise LinkError(f"{self.name}: closed by this program; open it again first")
        return self._bus

    def close(self) -> None:
        """Join the thread and free the bus."""
        bus, self._bus = self._bus, None
        lib.io_stop(bus)

    def check(self, status: int, where: str) -> None:
        """Raise LinkError for what can happen to any call."""
        if status == lib.IO_OK:
            return
        if status == lib.IO_CLOSED:
            # The thread may know before the notice has come through the loop.
            raise LinkError(self.ended or f"{self.name}: the transport has just failed; open it again")
        if status == lib.IO_NO_MEMORY:
            raise LinkError(f"{where}: no memory for a further link")
        raise LinkError(f"{where}: refused by the I/O thread (status {status}); an argument is out of range")
