"""Transports to a bus or a board: file descriptors that the link's C thread reads and writes."""

from pathlib import Path

from nodes.link.types import TransportKind
from nodes.support.errors import CanductorError
from nodes.transport.base import (
    ByteTransport,
    CanTransport,
    Transport,
    TransportBusyError,
    TransportClosedError,
)
from nodes.transport.frame import CanFrame
from nodes.transport.socketcan import SocketCanTransport
from nodes.transport.uart import BAUD_DEFAULT, UartTransport
from nodes.transport.virtual import VirtualTransport

__all__ = [
    "BAUD_DEFAULT",
    "ByteTransport",
    "CanFrame",
    "CanTransport",
    "Transport",
    "TransportBusyError",
    "TransportClosedError",
    "TransportKind",
    "open_can",
    "open_uart",
]


def open_can(spec: str, *, bitrate: int | None = None) -> CanTransport:
    """Open the CAN bus that SPEC names; raises CanductorError.

    ``can0``: the SocketCAN interface; ``virtual:PATH``: the project's virtual bus; ``INTERFACE:CHANNEL``: a
    backend of python-can. BITRATE in bit/s: backends of python-can are set to it; for the others it only
    states the rate that they already have.
    """
    interface, colon, channel = spec.partition(":")
    if not interface or (colon and not channel):
        raise CanductorError(
            f"CAN bus '{spec}': not a bus; give an interface (can0), virtual:PATH, or INTERFACE:CHANNEL of"
            " python-can"
        )
    if not colon:
        return SocketCanTransport(interface, bitrate=bitrate)
    if interface == "virtual":
        return VirtualTransport(channel, bitrate=bitrate)
    from nodes.transport.python_can_bridge import PythonCanBridge  # noqa: PLC0415 (3 MB, for who uses it)

    return PythonCanBridge.open(interface, channel, bitrate=bitrate)


def open_uart(path: str | Path, baud: int = BAUD_DEFAULT) -> UartTransport:
    """Open the serial device at PATH at BAUD bit/s; raises CanductorError."""
    return UartTransport(path, baud)
