"""What ``canductor can monitor`` is asked for."""

from collections.abc import Mapping
from dataclasses import dataclass

from canbus_tools.bus.open_bus import BusOptions
from canbus_tools.protocol.filters import Filter
from nodes.dictionary.dictionary import Dictionary


@dataclass(frozen=True, slots=True, kw_only=True)
class MonitorOptions:
    """Which bus, and what to show of it."""

    bus: BusOptions
    bitrate: int
    """That the load is reckoned with."""
    bitrate_is_known: bool
    filter_: Filter
    filter_text: str = "none"
    """For people."""
    dictionaries: Mapping[int, Dictionary]
    fetch: tuple[str, ...] = ()
    lines: bool = True
    as_json: bool = False
    duration_s: float | None = None
