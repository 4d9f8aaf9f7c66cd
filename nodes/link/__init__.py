"""Links: reliable, ordered command streams to nodes, and the I/O thread of the bus they share."""

from nodes.link.bus_io import LinkIO
from nodes.link.link import Link
from nodes.link.types import (
    BusDriver,
    BusLoad,
    BusSettings,
    Flow,
    Forecast,
    Frame,
    IOStats,
    LinkError,
    LinkSettings,
    LinkStats,
    LinkTransport,
    Response,
    TransportKind,
)

__all__ = [
    "BusDriver",
    "BusLoad",
    "BusSettings",
    "Flow",
    "Forecast",
    "Frame",
    "IOStats",
    "Link",
    "LinkError",
    "LinkIO",
    "LinkSettings",
    "LinkStats",
    "LinkTransport",
    "Response",
    "TransportKind",
]
