"""Shows how a job goes on: live on a terminal, now and then a plain line elsewhere.

Whoever runs the job calls ``update`` as often as is handy; drawing is limited here. No thread, no timer.
"""

import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from types import TracebackType
from typing import Self, TextIO

from rich.console import Console
from rich.live import Live
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

from nodes.support.terminal import printable, show

LIVE_INTERVAL_S = 0.2
PLAIN_INTERVAL_S = 5.0


@dataclass(frozen=True, slots=True, kw_only=True)
class NodeFigures:
    """How the link to one node does; None where nothing is known yet."""

    name: str
    round_trip_ms: float | None = None
    retransmitted_bytes: int = 0
    queue_depth: int = 0
    """Commands waiting in the host for this node."""
    lead_ms: float | None = None
    """How early the latest command came before it was due; the smaller, the nearer to a shutdown."""
    clock_error_us: float | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Progress:
    """One state of a job."""

    done: int
    total: int
    """0: not known."""
    unit: str = "bytes"
    """What done and total count."""
    print_time_s: float = 0.0
    wall_time_s: float = 0.0
    nodes: tuple[NodeFigures, ...] = ()
    bus_load: float | None = None
    """Share of the CAN bus in use, 0..1."""

    @property
    def share(self) -> float:
        """Return the part that is done, 0..1."""
        return min(self.done / self.total, 1.0) if self.total > 0 else 0.0

    @property
    def speed_ratio(self) -> float:
        """Return seconds of print time per second of wall time."""
        return self.print_time_s / self.wall_time_s if self.wall_time_s > 0 else 0.0


def summary(progress: Progress) -> str:
    """Return a job's state on one line."""
    parts = [
        f"{progress.done:,}/{progress.total:,} {progress.unit} ({progress.share:.0%})"
        if progress.total > 0
        else f"{progress.done:,} {progress.unit}",
        f"print time {progress.print_time_s:.1f} s",
        f"speed {progress.speed_ratio:.2f}x",
    ]
    if progress.bus_load is not None:
        parts.append(f"bus {progress.bus_load:.0%}")
    leads = [node.lead_ms for node in progress.nodes if node.lead_ms is not None]
    if leads:
        parts.append(f"lead {min(leads):.0f} ms")
    if repeated := sum(node.retransmitted_bytes for node in progress.nodes):
        parts.append(f"repeated {repeated:,} bytes")
    return ", ".join(parts)


class ProgressDisplay:
    """Context manager that draws the progress given to ``update``.

    On a terminal: a live table on stdout, redrawn at most five times a second, left standing at the end.
    With quiet (for --json) or without a terminal: one line on stderr at most every five seconds.
    """

    def __init__(
        self,
        title: str,
        *,
        quiet: bool = False,
        stdout: TextIO | None = None,
        stderr: TextIO | None = None,
        clock_s: Callable[[], float] = time.monotonic,
    ) -> None:
        self._title = printable(title)
        self._stdout = stdout or sys.stdout
        self._stderr = stderr or sys.stderr
        self._clock_s = clock_s
        self._is_live = not quiet and self._stdout.isatty()
        self._interval_s = LIVE_INTERVAL_S if self._is_live else PLAIN_INTERVAL_S
        # A plain line is for jobs that take long; a live picture shall stand at once.
        self._next_s = clock_s() + (0.0 if self._is_live else PLAIN_INTERVAL_S)
        self._last: Progress | None = None
        self._live: Live | None = None

    def __enter__(self) -> Self:
        if self._is_live:
            # rich is slow to import: only who looks at it pays for it.
            self._live = Live(console=Console(file=self._stdout), auto_refresh=False)
            self._live.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if self._live is not None:
            try:
                if self._last is not None:
                    self._live.update(self._picture(self._last), refresh=True)
            finally:
                self._live.stop()
                self._live = None

    def update(self, progress: Progress) -> None:
        """Take a new state; draws it when the last drawing is old enough."""
        self._last = progress
        now_s = self._clock_s()
        if now_s < self._next_s:
            return
        self._next_s = now_s + self._interval_s
        if self._live is not None:
            self._live.update(self._picture(progress), refresh=True)
        elif not self._is_live:
            show(f"{self._title}: {summary(progress)}", self._stderr)

    def _picture(self, progress: Progress) -> "Table":
        picture = Table.grid(padding=(0, 1))
        picture.add_row(Text(f"{self._title}: {summary(progress)}"))
        picture.add_row(ProgressBar(total=1.0, completed=progress.share, width=60))
        if progress.nodes:
            figures = Table(box=None, padding=(0, 2))
            figures.add_column("node")
            for heading in ("round trip ms", "repeated bytes", "queue", "lead ms", "clock µs"):
                figures.add_column(heading, justify="right")
            for node in progress.nodes:
                figures.add_row(
                    Text(printable(node.name)),
                    _figure(node.round_trip_ms, 2),
                    f"{node.retransmitted_bytes:,}",
                    f"{node.queue_depth:,}",
                    _figure(node.lead_ms, 0),
                    _figure(node.clock_error_us, 1),
                )
            picture.add_row(figures)
        return picture


def _figure(value: float | None, digits: int) -> str:
    return "–" if value is None else f"{value:,.{digits}f}"  # noqa: RUF001 (a dash for no value)
