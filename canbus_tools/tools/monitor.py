"""``canductor can monitor``: live traffic by names, as lines or on a screen, with figures of every node."""

import argparse
import json
import signal
import sys
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Final

from canbus_tools.bus.bus_load import BITRATE_MAX, LoadMeter
from canbus_tools.bus.computer import Computer, Listener, now_s
from canbus_tools.bus.open_bus import BusOptions, bus_options, declare_bus
from canbus_tools.bus.talk import BusTalk, refuse_if_in_use
from canbus_tools.bus.until_stopped import StopFlag, stop_flag
from canbus_tools.discovery.inventory import take_inventory
from canbus_tools.monitor.bus_watch import BusWatch
from canbus_tools.monitor.options import MonitorOptions
from canbus_tools.monitor.screen import MonitorScreen
from canbus_tools.protocol.decoded import Decoded
from canbus_tools.protocol.decoder import BusDecoder
from canbus_tools.protocol.dictionaries import DictionarySource, declare_dictionaries
from canbus_tools.protocol.filters import declare_filter, given_filter
from canbus_tools.protocol.lines import line_of
from canbus_tools.recordings.mcap_file import json_of
from canbus_tools.tools.load import find_bitrate
from nodes.dictionary.cache import DictionaryCache
from nodes.dictionary.dictionary import Dictionary
from nodes.support.can_protocol import DATA_NODEID_MAX
from nodes.support.errors import CanductorError
from nodes.support.option_values import UsageError, decimal, options_from, parse_int

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
        help="first download the dictionary of this node, or of 'all' that no host uses; sends frames",
    )
    declare_filter(command)
    add = command.add_argument
    add("--lines", action="store_true", help="print lines; the default if the output is no terminal")
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
        filter_=given_filter(given),
        filter_text=_filter_text(given),
        fetch=tuple(given.fetch or ()),
        lines=given.lines or given.json or not sys.stdout.isatty(),
        as_json=given.json,
    )
    if not options.lines and not sys.stdin.isatty():
        raise UsageError("the screen is operated by keys, but standard input is no terminal; give --lines")
    return lambda computer: run_monitor(computer, options)


def _fetched(text: str) -> str:
    return text if text == EVERY_NODE else str(parse_int(text, 1, DATA_NODEID_MAX, name="NODE"))


def run_monitor(computer: Computer, options: MonitorOptions) -> "MonitorReport":
    """Show the bus until the user has seen enough; raises CanductorError."""
    source = DictionarySource(options.dictionaries, DictionaryCache.of_user())
    if options.fetch:
        for nodeid, dictionary in computer.run(fetch(computer, options.bus, options.fetch)).items():
            source.put(nodeid, dictionary, FETCHED)
    watch = BusWatch(BusDecoder(source), LoadMeter(options.bitrate), now_s(computer))
    with computer.listen(options.bus) as queue:
        run = _run_lines if options.lines else _run_screen
        shown = run(computer, options, watch, queue)
        return MonitorReport(options, watch, shown, queue.dropped)


def _run_lines(computer: Computer, options: MonitorOptions, watch: BusWatch, queue: Listener) -> int:
    return Lines(computer, options, watch, queue).run()


def _run_screen(computer: Computer, options: MonitorOptions, watch: BusWatch, queue: Listener) -> int:
    before = signal.getsignal(signal.SIGTERM)
    screen = MonitorScreen(computer, options, watch, queue)
    screen.run()
    signal.signal(signal.SIGTERM, before)
    if screen.terminated:
        signal.raise_signal(signal.SIGTERM)
    if screen.failure is not None:
        raise screen.failure
    return screen.shown


async def fetch(computer: Computer, options: BusOptions, nodes: tuple[str, ...]) -> dict[int, Dictionary]:
    """Ask nodes for their dictionaries; raises CanductorError when one is in use, or does not answer."""
    found: dict[int, Dictionary] = {}
    async with BusTalk.open(computer, options) as bus:
        if EVERY_NODE in nodes:
            entries = (await take_inventory(bus)).entries
            wanted = [e.nodeid for e in entries if e.facts is not None and e.nodeid is not None]
            for entry in entries:
                if entry.facts is None and entry.nodeid is not None:
                    why = entry.trouble or "another host uses it"
                    sys.stderr.write(f"canductor: node {entry.nodeid} was not asked: {why}\n")
        else:
            wanted = [int(node) for node in nodes]
            for nodeid in wanted:
                await refuse_if_in_use(bus, nodeid)
        for nodeid in wanted:
            async with bus.node(nodeid) as talk:
                found[nodeid] = talk.dictionary
    return found


class Lines:
    """Writes what is said as lines, each at once."""

    def __init__(self, computer: Computer, options: MonitorOptions, watch: BusWatch, queue: Listener) -> None:
        self._computer = computer
        self._options = options
        self._watch = watch
        self._queue = queue
        self._form = json_line if options.as_json else line_of
        self._told_dropped = 0
        self._told: set[str] = set()

    def run(self) -> int:
        """Write until the duration is over, Ctrl-C or SIGTERM; returns how many lines.

        They end it between two lines: what was written was counted.
        """
        shown = 0
        with stop_flag() as flag:
            for said in self._said(flag):
                sys.stdout.write(self._form(said) + "\n")
                sys.stdout.flush()
                shown += 1
                if self._queue.dropped > 2 * self._told_dropped:
                    self._tell_dropped()
        if self._queue.dropped > self._told_dropped:
            self._tell_dropped()
        return shown

    def _tell_dropped(self) -> None:
        self._told_dropped = self._queue.dropped
        sys.stderr.write(
            f"canductor: {self._told_dropped} frames were dropped until now: lines are read too slowly\n"
        )

    def _tell_guesses(self) -> None:
        """Report each only once; there are at most 255 nodes, and 64 dictionaries in the cache."""
        guesses = {guess for node in self._watch.decoder.nodes.values() if (guess := node.guess)}
        for guess in sorted(guesses - self._told):
            sys.stderr.write(f"canductor: {guess}\n")
        self._told |= guesses

    def _said(self, flag: StopFlag) -> Iterator[Decoded]:
        passes = self._options.filter_.passes
        duration_s = self._options.duration_s
        end_s = None if duration_s is None else now_s(self._computer) + duration_s
        while not flag.stopped and (end_s is None or now_s(self._computer) < end_s):
            for frame in self._queue.take(_WAIT_S):
                for said in self._watch.feed(frame):
                    if flag.stopped:
                        return
                    if passes(said):
                        yield said
            self._tell_guesses()


def json_line(said: Decoded) -> str:
    """Return one thing as a JSON object."""
    return json.dumps({"time_s": said.time_s, **json_of(said)}, separators=(",", ":"))


@dataclass(frozen=True, slots=True)
class MonitorReport:
    """What was seen, in numbers."""

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
        """Return nothing: all has been shown."""
        return ""


def _filter_text(given: argparse.Namespace) -> str:
    """Return what ``declare_filter`` declared in the words that the screen's filter takes."""
    words = [f"node={','.join(map(str, given.node))}"] if given.node else []
    words += [f"kind={','.join(given.kind)}"] if given.kind else []
    words += [f"dir={given.direction}"] if given.direction else []
    return " ".join([*words, *(given.message or ())]) or "none"


def _bitrate(bus: BusOptions) -> tuple[int, bool]:
    """Return the bit rate to reckon with, and whether anybody said it."""
    try:
        return find_bitrate(bus), True
    except CanductorError:
        return BITRATE_MAX, False  # the usual one, and the screen says that it is assumed
