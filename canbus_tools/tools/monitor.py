"""``canductor can monitor``: live decoded traffic, as lines or on a screen, with statistics of every node."""

import argparse
import signal
import sys
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Final

from canbus_tools.bus.bus_load import LoadMeter
from canbus_tools.bus.computer import Computer, Listener, now_s
from canbus_tools.bus.open_bus import BITRATE_MAX, BusOptions, bus_options, declare_bus
from canbus_tools.bus.talk import BusTalk, refuse_if_in_use
from canbus_tools.bus.until_stopped import StopFlag, stop_flag
from canbus_tools.discovery.inventory import take_inventory
from canbus_tools.monitor.bus_watch import BusWatch, MonitorOptions
from canbus_tools.monitor.screen import MonitorScreen
from canbus_tools.protocol.decoded import Decoded
from canbus_tools.protocol.decoder import BusDecoder
from canbus_tools.protocol.dictionaries import DictionarySource, declare_dictionaries
from canbus_tools.protocol.filters import declare_filter, given_filter, read_filter
from canbus_tools.protocol.lines import line_of
from canbus_tools.recordings.mcap_file import json_line
from canbus_tools.tools.load import find_bitrate
from nodes.dictionary.cache import DictionaryCache
from nodes.dictionary.dictionary import Dictionary
from nodes.support.can_protocol import DATA_NODEID_MAX
from nodes.support.errors import CanductorError
from nodes.support.option_values import UsageError, decimal, options_from, parse_int
from nodes.support.terminal import show, show_error
from nodes.support.termination import TERMINATION

FETCHED: Final = "fetched from the node"
EVERY_NODE: Final = "all"
DURATION_MAX_S: Final = 86_400.0
_WAIT_S: Final = 0.1


def declare(command: argparse.ArgumentParser) -> None:
    """Add the options of the tool."""
    declare_bus(command)
    declare_dictionaries(command)
    command.add_argument(
        "--fetch",
        type=_fetched,
        metavar="NODE",
        action="append",
        help="first download the dictionary of this node, or of 'all' nodes that no host uses; sends frames",
    )
    declare_filter(command)
    add = command.add_argument
    add("--lines", action="store_true", help="print lines; default if the output is not a terminal")
    add(
        "--duration",
        dest="duration_s",
        type=decimal(0.1, DURATION_MAX_S, "s"),
        metavar="S",
        help="stop after this many seconds (default: at Ctrl-C)",
    )


def make_job(given: argparse.Namespace) -> "Callable[[Computer], MonitorReport]":
    """Check what was given; raises UsageError, CanductorError."""
    bus = bus_options(given)
    bitrate, is_known = _bitrate(bus)
    options = options_from(
        MonitorOptions,
        given,
        bus=bus,
        bitrate=bitrate,
        bitrate_is_known=is_known,
        filter_text=given_filter(given),
        fetch=tuple(given.fetch or ()),
        lines=given.lines or given.json or not sys.stdout.isatty(),
        as_json=given.json,
    )
    if not options.lines and not (sys.stdin is not None and sys.stdin.isatty()):
        raise UsageError("the screen needs a keyboard, but standard input is not a terminal; give --lines")
    return lambda computer: run_monitor(computer, options)


def _fetched(text: str) -> str:
    return text if text == EVERY_NODE else str(parse_int(text, 1, DATA_NODEID_MAX, name="NODE"))


def run_monitor(computer: Computer, options: MonitorOptions) -> "MonitorReport":
    """Show the bus until the user ends it; raises CanductorError."""
    source = DictionarySource(options.dictionaries, DictionaryCache.of_user())
    if options.fetch:
        for nodeid, dictionary in computer.run(fetch(computer, options.bus, options.fetch)).items():
            source.put(nodeid, dictionary, FETCHED)
    watch = BusWatch(BusDecoder(source), LoadMeter(options.bitrate), now_s(computer))
    with computer.listen(options.bus) as queue:
        if options.lines:
            shown = Lines(computer, options, watch, queue).run()
        else:
            shown = _run_screen(MonitorScreen(computer, options, watch, queue))
        return MonitorReport(options, watch, shown, queue.dropped)


def _run_screen(screen: MonitorScreen) -> int:
    before = {number: signal.getsignal(number) for number in TERMINATION}
    screen.run()
    for number, handler in before.items():
        signal.signal(number, handler)
    if screen.ended_by is not None:
        signal.raise_signal(screen.ended_by)
    if screen.failure is not None:
        raise screen.failure
    return screen.shown


async def fetch(computer: Computer, options: BusOptions, nodes: tuple[str, ...]) -> dict[int, Dictionary]:
    """Read the dictionaries of nodes; raises CanductorError if one is in use or does not answer."""
    found: dict[int, Dictionary] = {}
    async with BusTalk.open(computer, options) as bus:
        if EVERY_NODE in nodes:
            entries = (await take_inventory(bus)).entries
            wanted = [e.nodeid for e in entries if e.facts is not None and e.nodeid is not None]
            for entry in entries:
                if entry.facts is None and entry.nodeid is not None:
                    why = entry.trouble or "another host uses it"
                    show_error(f"canductor: node {entry.nodeid} was not queried: {why}")
        else:
            wanted = [int(node) for node in nodes]
            for nodeid in wanted:
                await refuse_if_in_use(bus, nodeid)
        for nodeid in wanted:
            async with bus.node(nodeid) as talk:
                found[nodeid] = talk.dictionary
    return found


class Lines:
    """Writes decoded traffic as lines, without delay."""

    def __init__(self, computer: Computer, options: MonitorOptions, watch: BusWatch, queue: Listener) -> None:
        self._computer = computer
        self._options = options
        self._watch = watch
        self._queue = queue
        self._form = json_line if options.as_json else line_of
        self._passes = read_filter(options.filter_text).passes
        self._reported_drops = 0
        self._reported: set[str] = set()

    def run(self) -> int:
        """Write until the duration is over, Ctrl-C, SIGTERM or SIGHUP; returns the number of lines.

        Signals end it between two lines, so that every line written is counted.
        """
        shown = 0
        with stop_flag() as flag:
            for said in self._said(flag):
                show(self._form(said))
                shown += 1
                if self._queue.dropped > 2 * self._reported_drops:
                    self._report_drops()
        if self._queue.dropped > self._reported_drops:
            self._report_drops()
        return shown

    def _report_drops(self) -> None:
        self._reported_drops = self._queue.dropped
        show_error(f"canductor: dropped {self._reported_drops} frames so far: lines are read too slowly")

    def _report_guesses(self) -> None:
        """Report each only once; there are at most 255 nodes, and 64 dictionaries in the cache."""
        guesses = {guess for node in self._watch.decoder.nodes.values() if (guess := node.guess)}
        for guess in sorted(guesses - self._reported):
            show_error(f"canductor: {guess}")
        self._reported |= guesses

    def _said(self, flag: StopFlag) -> Iterator[Decoded]:
        duration_s = self._options.duration_s
        end_s = None if duration_s is None else now_s(self._computer) + duration_s
        while not flag.stopped and (end_s is None or now_s(self._computer) < end_s):
            for frame in self._queue.take(_WAIT_S):
                for said in self._watch.feed(frame):
                    if flag.stopped:
                        return
                    if self._passes(said):
                        yield said
            self._report_guesses()


@dataclass(frozen=True, slots=True)
class MonitorReport:
    """Statistics of the traffic."""

    options: MonitorOptions
    watch: BusWatch
    shown: int
    dropped: int
    ok: bool = True

    def to_json(self) -> Mapping[str, object]:
        """Return the counters of the bus and of every node."""
        decoder, load = self.watch.decoder, self.watch.meter.load()
        return {
            "bus": self.options.bus.name,
            "lines": self.shown,
            "frames": self.watch.frames,
            "dropped_frames": self.dropped,
            "other_frames": decoder.other_frames,
            "error_frames": decoder.error_frames,
            "bitrate": self.options.bitrate,
            "bitrate_is_known": self.options.bitrate_is_known,
            "load": {"mean": round(load.mean, 6), "peak": round(load.peak, 6)},
            "nodes": [decoder.nodes[nodeid].to_json() for nodeid in sorted(decoder.nodes)],
        }

    def to_text(self) -> str:
        """Return nothing: everything was shown before."""
        return ""


def _bitrate(bus: BusOptions) -> tuple[int, bool]:
    """Return the bit rate to calculate with, and whether it is known."""
    try:
        return find_bitrate(bus), True
    except CanductorError:
        return BITRATE_MAX, False  # the usual one; the screen shows "assumed"
