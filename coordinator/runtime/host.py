"""What the machine needs of the computer it runs on: its time, its ports, and the loop its time passes in.

`LinuxHost` is the real one; a simulation takes its place with virtual time and simulated wires.
"""

import asyncio
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

from coordinator.config.model import CanConnection, UartConnection
from nodes.clock.clock import HostTime
from nodes.link import LinkIO
from nodes.link.interfaces import IoFactory, LinkIoInterface, OnFrame, OnLost
from nodes.node.board_reset import SetLines, SetPower
from nodes.transport import ByteTransport, CanTransport, open_can, open_uart
from nodes.transport.usb_power import usb_power_switch


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


class LinuxHost:
    """This computer: CLOCK_MONOTONIC, its CAN interfaces and its serial lines."""

    def make_loop(self) -> asyncio.AbstractEventLoop:
        """Return asyncio's own loop."""
        return asyncio.new_event_loop()

    def now(self) -> HostTime:
        """Return CLOCK_MONOTONIC."""
        return HostTime(time.monotonic_ns())

    def open_can(self, connection: CanConnection) -> Port:
        """Open SocketCAN, a virtual bus, or whatever the interface's name stands for."""
        return _port(open_can(connection.interface))

    def open_uart(self, connection: UartConnection) -> Port:
        """Open a device file."""
        uart = open_uart(connection.path, connection.baud)
        return _port(uart, uart.set_lines if uart.has_lines else None)

    def usb_power(self) -> SetPower | None:
        """Return the switch that Raspberry Pi computers have."""
        return usb_power_switch()


def _port(transport: CanTransport | ByteTransport, set_lines: SetLines | None = None) -> Port:
    def start(*, on_frame: OnFrame | None, on_closed: OnLost) -> LinkIoInterface:
        return LinkIO(transport, asyncio.get_running_loop(), on_frame=on_frame, on_closed=on_closed)

    return Port(transport.name, start, transport.close, set_lines)
