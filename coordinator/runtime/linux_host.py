"""The computer that this process runs on, as a host of a machine."""

import asyncio
import time

from coordinator.config.model import CanConnection, UartConnection
from coordinator.runtime.host import Port
from nodes.clock.clock import HostTime
from nodes.link import LinkIO
from nodes.link.interfaces import LinkIoInterface, OnFrame, OnLost
from nodes.node.board_reset import SetLines, SetPower
from nodes.transport import ByteTransport, CanTransport, open_can, open_uart
from nodes.transport.usb_power import usb_power_switch


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
