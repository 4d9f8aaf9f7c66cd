"""What is to be sent to drives without a coordinator, as the command line tells the tool that does it."""

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
    """What a device's name means."""

    CAN = "can"
    SERIAL = "serial"


@dataclass(frozen=True, slots=True)
class Load:
    """One transmission: PAIRS (none: remove the table) for AXLES."""

    axles: tuple[int, ...]
    pairs: tuple[Pair, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class DeviceJob:
    """LOADS for what is at DEVICE; without any, the nodes are only asked what AXLES keep."""

    device: str
    """``can0``, ``virtual:PATH`` or ``INTERFACE:CHANNEL`` of python-can; ``/dev/…`` or a pyserial URL."""
    loads: tuple[Load, ...] = ()
    axles: tuple[int, ...] = tuple(AXLES)
    delay_s: float | None = None
    """T, for drives that poll a register: one word at a time. None: as fast as the line or share allows."""
    nodes: tuple[int, ...] = ()
    """Ids on a CAN bus, of nodes that keep tables and can tell."""
    link: bool = False
    """Whether such a node is at the other end of the serial line."""
    force: bool = False
    """Talk to nodes to which somebody else seems to talk."""
    baud: int = BAUD
    bitrate: int | None = None
    """Of the CAN bus; None: as the interface knows."""
    share: float = SHARE
    can_id: int = MT_CAN_ID

    @property
    def kind(self) -> DeviceKind:
        """Read from the device's name; raises CanductorError for one that is none."""
        name = self.device
        if "://" in name or name.startswith("/"):
            return DeviceKind.SERIAL
        interface, colon, channel = name.partition(":")
        if not interface or (colon and not channel) or any(c.isspace() for c in interface):
            raise CanductorError(
                f"'{name}' is no device; give a CAN interface (can0), virtual:PATH, INTERFACE:CHANNEL of "
                "python-can, a serial device (/dev/ttyUSB0) or a pyserial URL (socket://HOST:PORT)"
            )
        return DeviceKind.CAN
