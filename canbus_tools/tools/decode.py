"""``canductor can decode``: shows recordings of buses as text."""

import argparse
import re
import select
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from io import FileIO
from pathlib import Path
from typing import BinaryIO, Final

from canbus_tools.bus.until_stopped import StopFlag, stop_flag
from canbus_tools.protocol.decoded import Decoded
from canbus_tools.protocol.decoder import BusDecoder
from canbus_tools.protocol.dictionaries import DictionarySource, declare_dictionaries
from canbus_tools.protocol.filters import Filter, declare_filter, given_filter, read_filter
from canbus_tools.protocol.frame import Frame
from canbus_tools.protocol.lines import line_of, name_of, table_of
from canbus_tools.recordings.mcap_file import json_line
from canbus_tools.recordings.recordings import STANDARD_INPUT, read_batches
from nodes.dictionary.cache import DictionaryCache
from nodes.dictionary.dictionary import Dictionary
from nodes.support.errors import CanductorError
from nodes.support.option_values import UsageError, existing_file
from nodes.support.terminal import show, show_error

LINES_HELD: Final = 500
"""Lines written at once."""
LOOK_S: Final = 0.1
"""Interval of checks for Ctrl-C without input."""
BUSES_MAX: Final = 64
"""Most buses in a recording; a file with more is damaged."""
_MOMENT: Final = re.compile(r"(\+?)(\d{1,12}(?:\.\d{1,9})?)\Z")


@dataclass(frozen=True, slots=True)
class Moment:
    """A time in a recording, in seconds of its own clock or relative to its first frame."""

    seconds: float
    relative: bool

    def at(self, first_s: float) -> float:
        """Return it as a time of the recording's clock."""
        return first_s + self.seconds if self.relative else self.seconds


def declare(command: argparse.ArgumentParser) -> None:
    """Add the options of the tool."""
    add = command.add_argument
    add(
        "files",
        type=_recording,
        metavar="FILE",
        nargs="+",
        help="candump log, BLF, ASC, pcap, pcapng or MCAP; - reads a candump log from standard input",
    )
    declare_dictionaries(command)
    declare_filter(command)
    moment = "in seconds of the recording's clock, or +SECONDS after its first frame"
    add("--since", type=_moment, metavar="TIME", help=f"start at this time, {moment}")
    add("--until", type=_moment, metavar="TIME", help="stop at this time")
    add("--summary", action="store_true", help="show only the counters of each node")


def make_job(given: argparse.Namespace) -> "Callable[[object], DecodeReport]":
    """Check what was given and return the job."""
    job = Decoding(
        filter_=read_filter(given_filter(given)),
        dictionaries=given.dictionaries,
        since=given.since,
        until=given.until,
        lines=not given.summary,
        as_json=given.json,
    )
    return lambda _: job.run(given.files)


def _recording(text: str) -> Path:
    path = Path(text)
    return path if path == STANDARD_INPUT else existing_file(path)


def _moment(text: str) -> Moment:
    match = _MOMENT.match(text)
    if match is None:
        raise UsageError(f"is '{text}', must be seconds such as 1700000000.5, or +2.5 after the start")
    return Moment(float(match[2]), bool(match[1]))


class _StoppedError(Exception):
    """The user ended it while it waited for input."""


def _readable(file: BinaryIO | FileIO) -> bool:
    """Wait for input, LOOK_S at most; True also for files that select cannot wait for."""
    try:
        return bool(select.select([file], [], [], LOOK_S)[0])
    except (OSError, ValueError):
        return True


class Decoding:
    """Decodes recordings as one: a block may begin in one file and end in the next."""

    def __init__(
        self,
        *,
        filter_: Filter,
        dictionaries: Mapping[int, Dictionary],
        since: Moment | None = None,
        until: Moment | None = None,
        lines: bool = True,
        as_json: bool = False,
    ) -> None:
        self.buses: dict[str, BusDecoder] = {}
        self.frames = 0
        self.shown = 0
        self.problems: list[str] = []
        self._passes = filter_.passes
        self._dictionaries = dictionaries
        self._cache = DictionaryCache.of_user()
        self._since, self._until = since, until
        self._begin_s = self._end_s = 0.0
        self._shows = lines
        self._form = json_line if as_json else line_of
        self._held: list[str] = []
        self._flag = StopFlag()

    def run(self, files: list[Path]) -> "DecodeReport":
        """Decode FILES; lines go to standard output, errors to the report."""
        with stop_flag() as self._flag:
            for file in files:
                if not self._flag.stopped:
                    self._decode(file)
            for bus in self.buses.values():
                self._take(bus.flush())
            self._write()
        return DecodeReport(self, self._flag.stopped, self._shows)

    def _decode(self, file: Path) -> None:
        try:
            for frames in read_batches(file, self._wait_for_input):
                if not self.frames:
                    self._set_limits(frames[0].time_s)
                if self._flag.stopped or self._feed(frames):
                    break
        except _StoppedError:
            pass
        except CanductorError as error:
            self.problems.append(str(error))

    def _wait_for_input(self, file: BinaryIO | FileIO) -> None:
        """Write the lines so far, and wait for input from FILE; Ctrl-C ends only the waiting."""
        self._write()
        while not (self._flag.stopped or _readable(file)):
            pass
        if self._flag.stopped:
            raise _StoppedError

    def _feed(self, frames: Sequence[Frame]) -> bool:
        """Decode FRAMES; return whether the end was reached.

        Each step handles all frames before the next step: that uses the processor's cache better and is a
        quarter faster.
        """
        buses, end_s = self.buses, self._end_s
        found: list[Decoded] = []
        for count, frame in enumerate(frames):
            if frame[0] > end_s:
                self.frames += count
                self._take(found)
                return True
            said = (buses.get(frame[4]) or self._new_bus(frame)).feed(frame)
            if said:
                found += said
        self.frames += len(frames)
        self._take(found)
        return False

    def _set_limits(self, first_s: float) -> None:
        self._begin_s = self._since.at(first_s) if self._since else float("-inf")
        self._end_s = self._until.at(first_s) if self._until else float("inf")

    def _new_bus(self, frame: Frame) -> BusDecoder:
        if len(self.buses) >= BUSES_MAX:
            raise CanductorError(
                f"frame {self.frames}: more than {BUSES_MAX} buses in one recording; the file may be damaged"
            )
        decoder = BusDecoder(DictionarySource(self._dictionaries, self._cache))
        self.buses[frame.channel] = decoder
        return decoder

    def _take(self, found: Iterable[Decoded]) -> None:
        if self._shows:
            passes, form, begin_s = self._passes, self._form, self._begin_s
            self._held += [form(said) for said in found if passes(said) and said[0] >= begin_s]
        if len(self._held) >= LINES_HELD:
            self._write()

    def _write(self) -> None:
        if not self._held:
            return
        self.shown += len(self._held)
        show("\n".join(self._held))
        self._held.clear()


@dataclass(frozen=True, slots=True)
class DecodeReport:
    """Counters of every node, and what could not be read."""

    _decoding: Decoding
    _stopped: bool
    _lines: bool

    @property
    def ok(self) -> bool:
        """Whether all files were read to their end."""
        return not self._decoding.problems

    def to_json(self) -> Mapping[str, object]:
        """Return the counters of every bus and node."""
        values: dict[str, object] = {
            "frames": self._decoding.frames,
            "lines": self._decoding.shown,
            "stopped": self._stopped,
            "buses": {
                name or "-": {
                    "nodes": [bus.nodes[nodeid].to_json() for nodeid in sorted(bus.nodes)],
                    "other_frames": bus.other_frames,
                    "error_frames": bus.error_frames,
                }
                for name, bus in self._decoding.buses.items()
            },
            "hints": self._hints(),
        }
        if self._decoding.problems:
            values["error"] = "; ".join(self._decoding.problems)
        self._warn(self._decoding.problems)
        return values

    def to_text(self) -> str:
        """Return the table of the counters where there were no lines; warnings go to standard error."""
        self._warn([*self._decoding.problems, *self._hints()])
        if self._lines:
            return ""
        parts = [f"{self._decoding.frames} frames"]
        for name, bus in self._decoding.buses.items():
            table = table_of(bus.nodes[nodeid] for nodeid in sorted(bus.nodes))
            others = f"{bus.other_frames} frames of other protocols, {bus.error_frames} error frames"
            parts.append(f"\nbus {name_of(name)}: {others}\n{table}")
        return "\n".join(parts)

    def _hints(self) -> list[str]:
        nodes = [node for bus in self._decoding.buses.values() for node in bus.nodes.values()]
        return [guess for node in nodes if (guess := node.guess)] + [
            f"node {node.nodeid}: {unread} of its blocks could not be read, as its dictionary is not in the "
            f"recording; give it by --dictionary {node.nodeid}=FILE"
            for node in nodes
            if (unread := node.to_node.unknown_messages + node.from_node.unknown_messages)
            and not node.dictionary_origin
        ]

    @staticmethod
    def _warn(sentences: list[str]) -> None:
        for sentence in sentences:
            show_error(f"canductor: {sentence}")
