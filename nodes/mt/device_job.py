"""Description of what the command line's tool is to send to drives without a coordinator."""

from dataclasses import dataclass
from enum import StrEnum
from typing import Final

from nodes.mt.mt import AXLES, Pair
from nodes.support.can_protocol import MT_CAN_ID
from nodes.support.errors import CanductorError

BAUD: Final = 250_000
SHARE: Final = 0.2
"""Of a CAN bus: as much as a coordinator uses for tables."""


class DeviceKind(StrEnum):
    """Kind of a device, derived from its name."""

    CAN = "can"
    SERIAL = "serial"


@dataclass(frozen=True, slots=True)
class Load:
    """One transmission: PAIRS (none: remove the table) for AXLES."""

    axles: tuple[int, ...]
    pairs: tuple[Pair, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class DeviceJob:
    """LOADS for the receivers at DEVICE; without any, the nodes are only queried for the tables of AXLES."""

    device: str
    """``can0``, ``virtual:PATH`` or ``INTERFACE:CHANNEL`` of python-can; ``/dev/…`` or a pyserial URL."""
    loads: tuple[Load, ...] = ()
    axles: tuple[int, ...] = tuple(AXLES)
    delay_s: float | None = None
    """T, for drives that poll a register: one word at a time. None: as fast as the line or share allows."""
    nodes: tuple[int, ...] = ()
    """Ids, on a CAN bus, of the nodes that keep tables and report them."""
    link: bool = False
    """Whether such a node is at the other end of the serial line."""
    force: bool = False
    """Whether to use nodes that another host seems to use."""
    baud: int = BAUD
    bitrate: int | None = None
    """Bit rate of the CAN bus; None: that of the interface."""
    share: float = SHARE
    can_id: int = MT_CAN_ID

    @property
    def kind(self) -> DeviceKind:
        """The kind, from the device's name; raises CanductorError for an invalid name."""
        name = self.device
        if "://" in name or name.startswith("/"):
            return DeviceKind.SERIAL
        interface, colon, channel = name.partition(":")
        if not interface or (colon and not channel) or any(c.isspace() for c in interface):
            raise CanductorError(
                f"'{name}' is not a device; give a CAN interface (can0), virtual:PATH, INTERFACE:CHANNEL of "
                "python-can, a serial device (/dev/ttyUSB0) or a pyserial URL (socket://HOST:PORT)"
            )
        return DeviceKind.CAN
