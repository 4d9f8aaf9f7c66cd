"""The wire of one bus: a port that is opened again when its bus comes back."""

from collections.abc import Callable

from coordinator.runtime.host import Port
from nodes.link.interfaces import LinkIoInterface, OnFrame, OnLost


class Wire:
    """Opens its port by OPEN_PORT each time the bus starts its I/O."""

    def __init__(self, open_port: Callable[[], Port]) -> None:
        self._open_port = open_port
        self._port: Port | None = None

    def start_io(self, *, on_frame: OnFrame | None, on_closed: OnLost) -> LinkIoInterface:
        """Open the port and start its I/O; an earlier one has ended. Raises CanductorError."""
        self.close()
        self._port = self._open_port()
        return self._port.start_io(on_frame=on_frame, on_closed=on_closed)

    def close(self) -> None:
        """Release the port, after its I/O has ended."""
        port, self._port = self._port, None
        if port is not None:
            port.close()
