"""Plain text of decoded messages and of each node's counters."""

import math
from collections.abc import Iterable

from canbus_tools.protocol.decoded import Decoded
from canbus_tools.protocol.protocol import Direction
from canbus_tools.protocol.traffic import NodeTraffic
from canbus_tools.support.text_table import table
from nodes.support.terminal import printable

_ENDS = {Direction.TO_NODE: "to", Direction.FROM_NODE: "from", Direction.ANY: "from"}
_NOBODY = {Direction.TO_NODE: "to all", Direction.FROM_NODE: "from ?", Direction.ANY: "-"}
_WORDS = {
    (nodeid, direction): (f"{word} {nodeid}" if nodeid is not None else _NOBODY[direction]).ljust(8)
    for nodeid in (None, *range(256))
    for direction, word in _ENDS.items()
}


def line_of(said: Decoded) -> str:
    """Return a line with time, bus, receiver or sender and the text, without the line's end."""
    time_s, channel, nodeid, direction, _, _, repeated, shape, values = said
    again = "  (repeated)" if repeated else ""
    return f"{time_s:.6f}  {name_of(channel)}  {_WORDS[nodeid, direction]}  {shape.text(values)}{again}"


def name_of(text: str) -> str:
    """Return the name TEXT of a bus or chip for people, - for none; recordings come from anywhere."""
    return printable(text) or "-"


_HEADINGS = ("node", "uuid", "mcu", "frames", "to", "from", "repeated", "missed", "naks", "invalid", "unread")


def table_of(nodes: Iterable[NodeTraffic]) -> str:
    """Return each node's counters as lines with a heading; to and from count messages."""
    rows: list[tuple[str, ...]] = []
    for node in nodes:
        ways = (node.to_node, node.from_node)
        cells = (
            node.nodeid,
            node.uuid or "-",
            name_of(node.mcu),
            sum(way.frames for way in ways),
            *(way.messages for way in ways),
            node.flow.repeated_blocks,
            node.flow.missed_blocks,
            node.flow.naks,
            sum(way.invalid_bytes for way in ways),
            sum(way.unknown_messages for way in ways),
            round_trip_text(node),
        )
        rows.append(tuple(map(str, cells)))
    return "\n".join(table((*_HEADINGS, "round trip (median, p99)"), rows, indent=""))


def round_trip_text(node: NodeTraffic) -> str:
    """Return the median and the 99th percentile of a node's round trips."""
    median_s, p99_s = (node.flow.round_trips.quantile_s(share) for share in (0.5, 0.99))
    return "-" if math.isnan(median_s) else f"{median_s * 1e3:.3g} ms, {p99_s * 1e3:.3g} ms"
