"""Links: reliable, ordered command streams to nodes, and the I/O thread of the bus they share.

In C: ``core/`` has a link and the schedule of a bus, ``io/`` the bus with all its links and its thread.
"""

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
