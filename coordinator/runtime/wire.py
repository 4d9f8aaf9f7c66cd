"""The wire of one bus: a port that is opened again when its bus comes back."""

from collections.abc import Callable

from coordinator.runtime.host import Port
from nodes.link.interfaces import LinkIoInterface, OnFrame, OnLost
from nodes.node.board_reset import SetLines, SetPower


class Wire:
    """Opens its port by OPEN_PORT each time the bus starts its I/O.

    SET_POWER switches the power of the computer's USB ports; None: nothing does.
    """

    def __init__(self, open_port: Callable[[], Port], set_power: SetPower | None = None) -> None:
        self._open_port = open_port
        self._port: Port | None = None
        self.set_power = set_power

    @property
    def set_lines(self) -> SetLines | None:
        """What sets DTR and RTS of the serial line; None: it is not open, or has no such lines."""
        return None if self._port is None else self._port.set_lines

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
