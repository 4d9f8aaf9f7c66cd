"""What a bus and its links share: the driver's C side, and the messages for its errors."""

import errno
import os
import threading
from typing import Any

from nodes.link.types import BusDriver, LinkError

_ENDED_ADVICE = {
    errno.ENETDOWN: "the interface was set down: set it up with 'ip link set {0} up'",
    errno.ENODEV: "the interface is gone: plug the adapter in",
}
"""Advice for a transport that ended, by errno; {0} is the transport's name."""


class BusHandle:
    """Owns the driver of one bus."""

    def __init__(self, driver: BusDriver) -> None:
        self._driver = driver
        self.name = driver.name
        """The transport's name, for messages."""
        self.ffi = driver.ffi
        self.lib = driver.lib
        self._bus: Any = driver.bus
        self.lock = threading.RLock()
        """Held by calls that other threads than the loop's may make, and while the driver is closed."""

    @property
    def open(self) -> bool:
        """Whether the driver is open: close() was not called yet."""
        return self._bus is not None

    def live(self) -> Any:
        """Return the ``struct io_bus *``; raises LinkError after close()."""
        if self._bus is None:
            raise LinkError(f"{self.name}: closed by this program; open it again first")
        return self._bus

    def close(self) -> None:
        """End the driver, which frees the bus."""
        with self.lock:
            self._bus = None
            self._driver.close()

    def ended_because(self, cause: int) -> str:
        """Return one sentence for a transport that ended by itself; CAUSE is an errno, or 0."""
        reason = os.strerror(cause) if cause else "its other end closed it"
        advice = _ENDED_ADVICE.get(cause, "check cable and device").format(self.name)
        return f"{self.name}: the connection ended ({reason}); {advice}, then start again"

    def check(self, status: int, where: str) -> None:
        """Raise LinkError for the errors that any call can have."""
        if status == self.lib.IO_OK:
            return
        if status == self.lib.IO_CLOSED:
            # The driver may have ended before the notice has passed through the loop.
            raise LinkError(self.ended_because(self.lib.io_end_cause(self.live())))
        if status == self.lib.IO_NO_MEMORY:
            raise LinkError(f"{where}: no memory for another link")
        raise LinkError(f"{where}: refused by the bus (status {status}); an argument is out of range")
