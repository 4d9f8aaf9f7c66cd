"""What a bus and its links share: the driver's C side, and the words for its refusals."""

from typing import Any

from nodes.link.types import BusDriver, LinkError


class BusHandle:
    """Owns the driver of one bus."""

    def __init__(self, driver: BusDriver) -> None:
        self._driver = driver
        self.name = driver.name
        """The transport's name, for messages."""
        self.ffi = driver.ffi
        self.lib = driver.lib
        self.ended: str | None = None
        """One sentence, once the transport has ended by itself."""
        self._bus: Any = driver.bus

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
        """End the driver, which frees the bus."""
        self._bus = None
        self._driver.close()

    def check(self, status: int, where: str) -> None:
        """Raise LinkError for what can happen to any call."""
        if status == self.lib.IO_OK:
            return
        if status == self.lib.IO_CLOSED:
            # The driver may know before the notice has come through the loop.
            raise LinkError(self.ended or f"{self.name}: the transport has just failed; open it again")
        if status == self.lib.IO_NO_MEMORY:
            raise LinkError(f"{where}: no memory for a further link")
        raise LinkError(f"{where}: refused by the bus (status {status}); an argument is out of range")
