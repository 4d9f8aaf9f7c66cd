"""Shows how a job goes on: live on a terminal, now and then a plain line elsewhere.

Whoever runs the job calls ``update`` as often as is handy; drawing is limited here. No thread, no timer.
"""

import functools
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from types import TracebackType
from typing import TYPE_CHECKING, Self, TextIO

if TYPE_CHECKING:
    from coordinator.support.progress_live import LiveProgress

from nodes.support.terminal import printable, show_error

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
    With quiet (for --json) or without a terminal: one line on stderr at most every five seconds. IS_BEHIND
    returns whether nobody reads what was drawn: then nothing is drawn.
    """

    def __init__(
        self,
        title: str,
        *,
        quiet: bool = False,
        stdout: TextIO | None = None,
        stderr: TextIO | None = None,
        clock_s: Callable[[], float] = time.monotonic,
        is_behind: Callable[[TextIO], bool] = lambda _: False,
    ) -> None:
        self._title = printable(title)
        self._stdout = stdout or sys.stdout
        self._stderr = stderr or sys.stderr
        self._clock_s = clock_s
        self._is_live = not quiet and self._stdout.isatty()
        stream = self._stdout if self._is_live else self._stderr
        self._is_behind = functools.partial(is_behind, stream)
        self._interval_s = LIVE_INTERVAL_S if self._is_live else PLAIN_INTERVAL_S
        # A plain line is for jobs that take long; a live picture shall stand at once.
        self._next_s = clock_s() + (0.0 if self._is_live else PLAIN_INTERVAL_S)
        self._last: Progress | None = None
        self._live: LiveProgress | None = None

    def __enter__(self) -> Self:
        if self._is_live:
            from coordinator.support.progress_live import LiveProgress  # noqa: PLC0415 (rich: for who looks)

            self._live = LiveProgress(self._title, self._stdout)
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
                    self._live.show(self._last)
            finally:
                self._live.stop()
                self._live = None

    def update(self, progress: Progress) -> None:
        """Take a new state; draws it when the last drawing is old enough."""
        self._last = progress
        now_s = self._clock_s()
        if now_s < self._next_s or self._is_behind():
            return
        self._next_s = now_s + self._interval_s
        if self._live is not None:
            self._live.show(progress)
        elif not self._is_live:
            show_error(f"{self._title}: {summary(progress)}", self._stderr)
