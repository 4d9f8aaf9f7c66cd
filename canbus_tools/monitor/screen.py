"""The monitor's screen: load, a table of the nodes, and a log of what is said."""

import asyncio
import signal
from collections import deque
from collections.abc import Sequence
from typing import ClassVar, Final

from rich.text import Text
from textual import events, on
from textual.app import App, ComposeResult
from textual.binding import Binding, BindingType
from textual.containers import Vertical
from textual.widgets import DataTable, Footer, Input, RichLog, Static

from canbus_tools.bus.computer import Computer, Listener, now_s
from canbus_tools.monitor.bus_watch import BusRates, BusWatch, MonitorOptions
from canbus_tools.monitor.text import COLUMNS, bar_line, cells, log_line
from canbus_tools.protocol.decoded import Decoded, Kind
from canbus_tools.protocol.filters import read_filter
from nodes.support.errors import CanductorError
from nodes.support.option_values import UsageError
from nodes.support.termination import TERMINATION

REFRESH_S: Final = 0.25
KEPT: Final = 20_000
"""Number of messages that are kept, for a change of the filter."""
LOG_LINES: Final = 2_000
LOG_FRAME: Final = 3
"""Width of padding and scroll bar."""
LINES_AT_ONCE: Final = 60
"""Most lines added by one refresh, about a screenful; a line reports how many were omitted."""


class MonitorScreen(App[None]):
    """Shows WATCH, fed from QUEUE, until the user quits or the bus fails (see ``failure``)."""

    TITLE = "canductor can monitor"
    ENABLE_COMMAND_PALETTE = False
    CSS = """
    Screen { layout: vertical; background: $background; }
    #load { height: 2; padding: 0 1; background: $panel; }
    #nodes { height: auto; max-height: 40%; background: $background; }
    #nodes > .datatable--header { background: $surface; color: $text-muted; text-style: none; }
    #state { height: 1; padding: 0 1; background: $surface; color: $text-muted; }
    #log { height: 1fr; padding: 0 1; background: $background; scrollbar-size-vertical: 1; }
    #filter { display: none; height: 3; border: tall $accent; }
    #filter.asked { display: block; }
    """
    BINDINGS: ClassVar[list[BindingType]] = [
        Binding("q", "quit", "Quit"),
        Binding("space", "pause", "Pause"),
        Binding("slash", "ask_filter", "Filter", key_display="/"),
        Binding("a", "acks", "Acks"),
        Binding("c", "clear", "Clear log"),
        Binding("escape", "leave_filter", "Leave", show=False),
        Binding("ctrl+c", "quit", "Quit", show=False, priority=True),
    ]

    def __init__(self, computer: Computer, options: MonitorOptions, watch: BusWatch, queue: Listener) -> None:
        super().__init__()
        self.failure: CanductorError | None = None
        self.ended_by: signal.Signals | None = None
        """SIGTERM or SIGHUP, if that was received."""
        self.shown = 0
        """Number of lines written to the log."""
        self._computer = computer
        self._options = options
        self._watch = watch
        self._queue = queue
        self._filter = read_filter(options.filter_text)
        self._filter_text = options.filter_text
        self._acks = False
        self._paused = False
        self._said: deque[Decoded] = deque(maxlen=KEPT)
        self._unshown = 0
        """Number of messages while the log was paused."""
        self._columns: tuple[str, ...] = ()
        self._width = 80
        self._end_s = None if options.duration_s is None else now_s(computer) + options.duration_s

    def compose(self) -> ComposeResult:
        """Create the widgets."""
        with Vertical():
            yield Static(id="load")
            yield DataTable(id="nodes", cursor_type="none", zebra_stripes=False)
            yield Static(id="state")
            yield RichLog(id="log", max_lines=LOG_LINES, wrap=False, highlight=False, markup=False)
            yield Input(id="filter", placeholder="node=4 kind=nak dir=from get_*   empty: everything")
        yield Footer()

    def on_mount(self) -> None:
        """Start the screen."""
        self.theme = "textual-dark"
        log = self.query_one("#log", RichLog)
        log.can_focus = True
        log.focus()
        self.set_interval(REFRESH_S, self.refresh_now)
        # The command line's handlers would end the program before the terminal is restored.
        for number in TERMINATION:
            if signal.getsignal(number) is not signal.SIG_IGN:
                asyncio.get_running_loop().add_signal_handler(number, self._end_by, number)

    def _end_by(self, number: signal.Signals) -> None:
        self.ended_by = number
        self.exit()

    def on_resize(self, event: events.Resize) -> None:
        """Show as many columns as fit."""
        changed = event.size.width != self._width
        self._width = event.size.width
        self._choose_columns(self._width)
        self._show(self._watch.update(now_s(self._computer)))
        if changed:
            self._rewrite()

    # --------------------------------------------------------------------------------------------- refreshing

    def refresh_now(self) -> None:
        """Show what was received."""
        if len(self.query("#load, #state, #nodes, #log")) < 4:  # the timer may outlive the widgets
            return
        try:
            frames = self._queue.take()
        except CanductorError as error:
            self.failure = error
            self.exit()
            return
        new: list[Decoded] = []
        for frame in frames:
            new += self._watch.feed(frame)
        self._said.extend(new)
        wanted = [said for said in new if self._passes(said)]
        if self._paused:
            self._unshown += len(wanted)
        else:
            self._write(wanted)
        passed_s = now_s(self._computer)
        self._show(self._watch.update(passed_s))
        if self._end_s is not None and passed_s >= self._end_s:
            self.exit()

    def _passes(self, said: Decoded) -> bool:
        if said.kind is Kind.ACK and self._acks:
            return self._filter.passes(said._replace(kind=Kind.NAK))
        return self._filter.passes(said)

    def _write(self, said: Sequence[Decoded]) -> None:
        log = self.query_one("#log", RichLog)
        left_out = len(said) - LINES_AT_ONCE
        if left_out > 0:
            log.write(Text(f"… {left_out} more omitted: filter with /, or use --lines", "dim italic"))
        for item in said[-LINES_AT_ONCE:]:
            log.write(log_line(item, self._width - LOG_FRAME))
        self.shown += min(len(said), LINES_AT_ONCE)

    def _show(self, rates: BusRates) -> None:
        if not self._columns:
            return
        width = self._width
        self.query_one("#load", Static).update(
            bar_line(self._options, self._watch, rates, self._queue.dropped, width - 2)
        )
        self.query_one("#state", Static).update(self._state())
        table = self.query_one("#nodes", DataTable)
        rows = {str(node.node.nodeid): cells(node, self._columns) for node in rates.nodes}
        if set(rows) != {key.value for key in table.rows}:
            table.clear()
            for key, row in rows.items():
                table.add_row(*row, key=key)
            return
        for key, row in rows.items():
            for name, cell in zip(self._columns, row, strict=True):
                table.update_cell(key, name, cell)

    def _choose_columns(self, width: int) -> None:
        chosen: set[str] = set()
        left = width - 1
        for name, column in sorted(COLUMNS.items(), key=lambda item: item[1].importance):
            if column.width + 2 <= left:
                chosen.add(name)
                left -= column.width + 2
        columns = tuple(name for name in COLUMNS if name in chosen)
        if columns == self._columns:
            return
        self._columns = columns
        table = self.query_one("#nodes", DataTable)
        table.clear(columns=True)
        for name in columns:
            column = COLUMNS[name]
            table.add_column(Text(column.heading, justify=column.justify), key=name, width=column.width)

    def _state(self) -> Text:
        text = Text(no_wrap=True, overflow="ellipsis")
        if self._paused:
            text.append("PAUSED", "bold yellow")
            text.append(f", {self._unshown} since   ")
        text.append(f"filter: {self._filter_text or 'none'}")
        text.append("   acks shown" if self._acks else "")
        nodes = self._watch.decoder.nodes.values()
        strangers = sorted(node.nodeid for node in nodes if not node.dictionary_origin)
        if strangers:
            text.append(f"   no dictionary of {', '.join(map(str, strangers))}", "yellow")
            text.append(f" (--fetch {strangers[0]})")
        guessed = sorted(node.nodeid for node in nodes if node.guess)
        if guessed:
            text.append(f"   dictionary of {', '.join(map(str, guessed))} guessed", "yellow")
        if not self._watch.frames:
            text.append("   no frame received yet: check that nodes and host are running", "yellow")
        return text

    # --------------------------------------------------------------------------------------------------- keys

    def action_pause(self) -> None:
        """Pause or resume the log, but not the figures."""
        self._paused = not self._paused
        self.query_one("#log", RichLog).auto_scroll = not self._paused
        if not self._paused:
            self._rewrite()

    def action_acks(self) -> None:
        """Show or hide acknowledgements."""
        self._acks = not self._acks
        self._rewrite()

    def action_clear(self) -> None:
        """Empty the log."""
        self._said.clear()
        self._unshown = 0
        self.query_one("#log", RichLog).clear()

    def action_ask_filter(self) -> None:
        """Open the filter's input."""
        entry = self.query_one("#filter", Input)
        entry.add_class("asked")
        entry.focus()

    def action_leave_filter(self) -> None:
        """Close the input without a change."""
        self.query_one("#filter", Input).remove_class("asked")
        self.query_one("#log", RichLog).focus()

    @on(Input.Submitted, "#filter")
    def take_filter(self, submitted: Input.Submitted) -> None:
        """Use the filter that was entered."""
        text = " ".join(submitted.value.split())
        try:
            self._filter = read_filter(text)
        except UsageError as error:
            self.notify(str(error), severity="error")
            return
        self._filter_text = text
        self.action_leave_filter()
        self._rewrite()

    def _rewrite(self) -> None:
        """Fill the log again from the messages kept."""
        self._unshown = 0
        log = self.query_one("#log", RichLog)
        log.clear()
        for item in [said for said in self._said if self._passes(said)][-LOG_LINES:]:
            log.write(log_line(item, self._width - LOG_FRAME))
