"""Output of a virtual bus with faults: a status line while it runs, figures at the end."""

import shutil
import time
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any, Final, TextIO

from canbus_tools.support.text_table import table
from nodes.support.terminal import show
from nodes.virtual.hub import BusStats, ClientStats, VirtualBus

_DAMAGE: Final = {
    "lost": "lost",
    "lost_copies": "lost by one receiver",
    "corrupted": "corrupted",
    "duplicated": "duplicated",
    "errors": "error frames",
    "delayed": "delayed",
    "bus_offs": "bus-off",
    "unsent": "not sent while off",
    "unheard": "not heard while off",
    "expelled": "clients disconnected, as they did not read",
    "refused": "clients refused, as there were too many",
    "rejected": "invalid records",
}
"""Counters of BusStats that are shown if they are not 0."""


CLEAR_LINE: Final = "\r\x1b[K"


class StatusLine:
    """A line on a terminal that is updated in place."""

    def __init__(self, stream: TextIO, bus: VirtualBus) -> None:
        """Show BUS, from now on, on STREAM."""
        self._stream = stream
        self._bus = bus
        self._begin_s = self._last_s = time.monotonic()
        self._before = bus.stats

    def show(self, socketcand_clients: int) -> None:
        """Update the line."""
        now_s, stats = time.monotonic(), self._bus.stats
        text = status(self._before, stats, now_s - self._last_s, now_s - self._begin_s)
        if socketcand_clients:
            text += f"  socketcand {socketcand_clients}"
        width = shutil.get_terminal_size().columns - 1  # a wrapped line could not be overwritten
        show(text[:width], self._stream, before=CLEAR_LINE, end="")
        self._last_s, self._before = now_s, stats

    def clear(self) -> None:
        """Clear the line for further output."""
        show("", self._stream, before=CLEAR_LINE, end="")


def status(before: BusStats, now: BusStats, passed_s: float, ran_s: float) -> str:
    """Return one line about the last PASSED_S of a run of RAN_S."""
    passed_s = max(passed_s, 1e-3)
    load = (now.busy_ns - before.busy_ns) / 1e9 / passed_s
    rate = (now.frames - before.frames) / passed_s
    parts = [f"{ran_s:.1f} s", f"load {load:.1%}", f"{rate:,.0f} frames/s", f"clients {len(now.clients)}"]
    figures = asdict(now)
    parts += [f"{words.split(',')[0]} {figures[name]:,}" for name, words in _DAMAGE.items() if figures[name]]
    return "  ".join(parts)


@dataclass(frozen=True, slots=True, kw_only=True)
class InjectReport:
    """The figures of a run."""

    path: str
    bitrate: int
    seed: int
    ran_s: float
    stats: BusStats
    faults: tuple[str, ...]
    """The option that requested each fault."""
    nodes: Mapping[str, Mapping[str, Any]]
    """Counters of each node by name, in the order of their places."""
    socketcand: Mapping[str, int] | None
    ok: bool = True

    def to_json(self) -> Mapping[str, object]:
        """Return all figures."""
        figures = asdict(self.stats)
        counted = figures.pop("faults")
        return {
            "bus": self.path,
            "bitrate": self.bitrate,
            "seed": self.seed,
            "seconds": self.ran_s,
            **figures,
            "faults": [{"fault": words, **count} for words, count in zip(self.faults, counted, strict=True)],
            "nodes": self.nodes,
            "socketcand": self.socketcand,
        }

    def to_text(self) -> str:
        """Return the figures for a reader."""
        stats = self.stats
        rate = f"{self.bitrate:,} bit/s" if self.bitrate else "unlimited rate"
        load = f", load {stats.busy_ns / 1e9 / self.ran_s:.1%}" if self.bitrate and self.ran_s else ""
        lines = [f"{self.ran_s:.1f} s at {rate}, seed {self.seed}: {stats.frames:,} frames{load}"]
        figures = asdict(stats)
        lines += [f"  {figures[name]:,} {words}" for name, words in _DAMAGE.items() if figures[name]]
        lines += self._fault_lines()
        lines += self._client_lines()
        if self.socketcand is not None:
            seen = self.socketcand
            lines.append(
                f"socketcand: {seen['clients']} clients, {seen['errors']} bad commands, {seen['slow']}"
                f" disconnected because they did not read, {seen['refused']} refused"
            )
        return "\n".join(lines)

    def _fault_lines(self) -> list[str]:
        rows = [
            (words, f"{count.picked:,}", f"{count.hits:,}")
            for words, count in zip(self.faults, self.stats.faults, strict=True)
        ]
        return _figures(("fault", "frames seen", "hits"), rows)

    def _client_lines(self) -> list[str]:
        names = list(self.nodes)

        def name_of(client: ClientStats) -> str:
            return names[client.place] if client.place < len(names) else f"client {client.place}"

        rows = [
            (name_of(client), f"{client.sent:,}", f"{client.received:,}") for client in self.stats.clients
        ]
        return _figures(("still connected", "sent", "received"), rows)


def _figures(headings: tuple[str, str, str], rows: list[tuple[str, str, str]]) -> list[str]:
    """Return a table with two columns of right-aligned figures; nothing without rows."""
    return table(headings, [(row[0], f"{row[1]:>8}", f"{row[2]:>8}") for row in rows], "") if rows else []
