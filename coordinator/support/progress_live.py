"""A table on a terminal that shows how a job goes on; in a file of its own, as few commands draw one."""

from typing import TextIO

from rich.console import Console
from rich.live import Live
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

from coordinator.support.progress import Progress, summary
from nodes.support.terminal import printable


class LiveProgress:
    """Draws on STDOUT from now until ``stop``; what was drawn last is left standing."""

    def __init__(self, title: str, stdout: TextIO) -> None:
        self._title = title
        self._live = Live(console=Console(file=stdout), auto_refresh=False)
        self._live.start()

    def show(self, progress: Progress) -> None:
        """Draw PROGRESS instead of what is drawn."""
        self._live.update(self._picture(progress), refresh=True)

    def stop(self) -> None:
        """Draw no more."""
        self._live.stop()

    def _picture(self, progress: Progress) -> Table:
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
