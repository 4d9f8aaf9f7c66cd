"""Text of the monitor's screen: the lines of its head, table and log."""

import math
import textwrap
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Final, Literal

from rich.text import Text

from canbus_tools.monitor.bus_watch import BusRates, BusWatch, MonitorOptions, NodeRates
from canbus_tools.protocol.decoded import Decoded, Kind
from canbus_tools.protocol.protocol import Direction

BUSY, FULL = 0.5, 0.8
"""Loads from which the bar is yellow or red."""
ROOM_MIN: Final = 20
"""Characters for the text of a line on the narrowest screen."""
_EIGHTHS: Final = " ▏▎▍▌▋▊▉"
_SPARKS: Final = "▁▂▃▄▅▆▇█"
_STYLES: Final[Mapping[Kind, str]] = {
    Kind.ADMIN: "magenta",
    Kind.SIGNAL: "bold red",
    Kind.NAK: "yellow",
    Kind.NOISE: "yellow",
    Kind.ERROR: "bold red",
    Kind.OTHER: "dim",
    Kind.ACK: "dim",
}


# ----------------------------------------------------------------------------------------------------- head


def bar_line(options: MonitorOptions, watch: BusWatch, rates: BusRates, dropped: int, width: int) -> Text:
    """Return the two lines of the head, WIDTH characters wide."""
    load = watch.meter.load()
    right = f" {rates.load:5.1%}  mean {load.mean:.1%}  peak {load.peak:.1%}"
    room = max(4, width - len(right) - 5)
    text = Text("load ", no_wrap=True, overflow="ellipsis")
    text.append(_bar(rates.load, room), _load_style(rates.load))
    text.append(right + "\n")
    known = "" if options.bitrate_is_known else " assumed"
    text.append(options.bus.name if len(options.bus.name) <= 16 else "…" + options.bus.name[-15:], "bold")
    text.append(f"  {options.bitrate / 1000:g} kbit/s{known}  {rates.frames_per_s:.0f} frames/s")
    counts = ((watch.decoder.error_frames, "errors"), (watch.decoder.other_frames, "foreign"))
    for count, what in (*counts, (dropped, "dropped")):
        text.append(f"  {count} {what}", "bold yellow" if count else "")
    left = width - len(text.plain.splitlines()[-1]) - 2
    if left >= 10:
        loads = list(watch.loads)[-left:]
        text.append("  " + "".join(_SPARKS[min(7, int(max(0.0, share) * 8))] for share in loads), "cyan")
    return text


def _bar(share: float, width: int) -> str:
    eighths = round(min(1.0, max(0.0, share)) * width * 8)
    whole_, rest = divmod(eighths, 8)
    return ("█" * whole_ + (_EIGHTHS[rest] if rest else "")).ljust(width, "·")


def _load_style(share: float) -> str:
    if share >= FULL:
        return "red"
    return "yellow" if share >= BUSY else "green"


# ---------------------------------------------------------------------------------------------------- table


@dataclass(frozen=True, slots=True)
class Column:
    """A column of the table of nodes."""

    heading: str
    width: int
    importance: int
    """Columns with high numbers are the first to be hidden on a narrow screen."""
    text: Callable[[NodeRates], str]
    justify: Literal["left", "right"] = "right"
    alarming: bool = False
    """Whether any value but 0 is highlighted."""


def _time_text(time_s: float) -> str:
    if math.isnan(time_s):
        return "-"
    return f"{time_s * 1e3:.2f}" if time_s < 0.1 else f"{time_s * 1e3:.0f}"


def _silence(rates: NodeRates) -> str:
    heard_s = rates.node.last_heard_s
    if math.isnan(heard_s):
        return "never"
    silent_s = max(0.0, time.time() - heard_s)
    return f"{silent_s:.0f} s" if silent_s < 1000 else f"{silent_s / 60:.0f} min"


COLUMNS: Final[Mapping[str, Column]] = {
    "node": Column("node", 4, 0, lambda r: str(r.node.nodeid)),
    "mcu": Column("MCU", 17, 8, lambda r: r.node.mcu or "?", "left"),
    "uuid": Column("uuid", 12, 10, lambda r: r.node.uuid or "-", "left"),
    "to": Column("to/s", 5, 2, lambda r: f"{r.messages_to:.0f}"),
    "from": Column("from/s", 6, 1, lambda r: f"{r.messages_from:.0f}"),
    "bytes": Column("B/s", 6, 7, lambda r: f"{r.bytes_to + r.bytes_from:.0f}"),
    "load": Column("load", 5, 3, lambda r: f"{r.load:.1%}"),
    "repeated": Column("rpt", 4, 4, lambda r: str(r.node.flow.repeated_blocks), alarming=True),
    "naks": Column("nak", 4, 9, lambda r: str(r.node.flow.naks), alarming=True),
    "bad": Column(
        "bad B",
        5,
        6,
        lambda r: str(r.node.to_node.invalid_bytes + r.node.from_node.invalid_bytes),
        alarming=True,
    ),
    "rtt": Column("RTT ms", 6, 5, lambda r: _time_text(r.node.flow.round_trips.quantile_s(0.5))),
    "p99": Column("p99", 6, 11, lambda r: _time_text(r.node.flow.round_trips.quantile_s(0.99))),
    "missed": Column("missed", 6, 13, lambda r: str(r.node.flow.missed_blocks), alarming=True),
    "unread": Column(
        "unread",
        6,
        14,
        lambda r: str(r.node.to_node.unknown_messages + r.node.from_node.unknown_messages),
        alarming=True,
    ),
    "silent": Column("silent", 7, 12, _silence),
    "dictionary": Column("dictionary", 24, 15, lambda r: r.node.dictionary_origin or "none", "left"),
    "version": Column("firmware", 20, 16, lambda r: r.node.version or "?", "left"),
}


def cells(rates: NodeRates, columns: tuple[str, ...]) -> list[Text]:
    """Return a node's row."""
    row = []
    for name in columns:
        column = COLUMNS[name]
        text = column.text(rates)[: column.width]
        style = "bold yellow" if column.alarming and text != "0" else ""
        row.append(Text(text, style, justify=column.justify, no_wrap=True))
    return row


# ------------------------------------------------------------------------------------------------------ log


def log_line(said: Decoded, width: int) -> Text:
    """Return an entry of the log, WIDTH wide: local time, node, direction and wrapped text."""
    text = Text(no_wrap=True)
    seconds = said.time_s % 60
    clock = time.strftime("%H:%M", time.localtime(said.time_s)) if 0 <= said.time_s < 1 << 33 else "--:--"
    text.append(f"{clock}:{seconds:09.6f} ", "dim")
    style = "cyan" if said.direction is Direction.TO_NODE else "green"
    arrow = {Direction.TO_NODE: "→", Direction.FROM_NODE: "←"}.get(said.direction, " ")
    text.append(f"{'' if said.nodeid is None else said.nodeid:>3} {arrow} ", style)
    room = max(ROOM_MIN, width - len(text))
    pieces = textwrap.wrap(said.text, room, break_on_hyphens=False) or [""]
    text.append(("\n" + " " * len(text)).join(pieces), _STYLES.get(said.kind, ""))
    if said.repeated:
        text.append("  repeated", "yellow")
    return text
