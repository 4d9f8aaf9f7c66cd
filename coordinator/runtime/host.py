"""What the machine needs of the computer it runs on: its time, its ports, and the loop its time passes in.

`runtime.linux_host` has the real one; a simulation takes its place with virtual time and simulated wires.
"""

import asyncio
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

from coordinator.config.model import CanConnection, UartConnection
from nodes.clock.clock import HostTime
from nodes.link.interfaces import IoFactory
from nodes.node.board_reset import SetLines, SetPower


@dataclass(frozen=True, slots=True)
class Port:
    """One open CAN interface or UART."""

    name: str
    """For messages: as the user wrote it."""
    start_io: IoFactory
    close: Callable[[], None]
    """Let go of the device, after its I/O has ended."""
    set_lines: SetLines | None = None
    """Set DTR and RTS of a serial line, also while its I/O runs; None: it has none, as a pseudo-terminal."""


class Host(Protocol):
    """Time and ports."""

    def now(self) -> HostTime:
        """Return the host time, as the links stamp their messages; from any thread."""
        ...

    def open_can(self, connection: CanConnection) -> Port:
        """Open a CAN interface; raises CanductorError."""
        ...

    def open_uart(self, connection: UartConnection) -> Port:
        """Open a UART; raises CanductorError."""
        ...

    def usb_power(self) -> SetPower | None:
        """Return what switches the power of the USB ports; None: the computer cannot do that."""
        ...


class Computer(Host, Protocol):
    """A host that whole commands run on."""

    def make_loop(self) -> asyncio.AbstractEventLoop:
        """Return a new event loop in which this host's time passes."""
        ...
