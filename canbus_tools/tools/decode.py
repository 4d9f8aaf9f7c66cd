"""``canductor can decode``: recordings of buses as lines of text."""

import argparse
import json
import re
import select
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO, Final

from canbus_tools.bus.until_stopped import StopFlag, stop_flag
from canbus_tools.protocol.decoded import Decoded
from canbus_tools.protocol.decoder import BusDecoder
from canbus_tools.protocol.dictionaries import DictionarySource, declare_dictionaries
from canbus_tools.protocol.filters import Filter, declare_filter, given_filter
from canbus_tools.protocol.frame import Frame
from canbus_tools.protocol.lines import line_of, printable, table_of
from canbus_tools.recordings.mcap_file import json_of
from canbus_tools.recordings.recordings import STANDARD_INPUT, read_batches
from nodes.dictionary.cache import DictionaryCache
from nodes.dictionary.dictionary import Dictionary
from nodes.support.errors import CanductorError
from nodes.support.option_values import UsageError, existing_file

LINES_HELD: Final = 500
"""Lines written at once."""
LOOK_S: Final = 0.1
"""How soon Ctrl-C is noticed while nothing comes in."""
BUSES_MAX: Final = 64
"""Names of buses that are distinguished; a file with more is no recording."""
_MOMENT: Final = re.compile(r"(\+?)(\d{1,12}(?:\.\d{1,9})?)\Z")


@dataclass(frozen=True, slots=True)
class Moment:
    """A time in a recording, in seconds: as the recording counts, or from its first frame."""

    seconds: float
    relative: bool

    def at(self, first_s: float) -> float:
        """Return it as the recording counts."""
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
    moment = "in seconds as the recording counts them, or +SECONDS after its first frame"
    add("--since", type=_moment, metavar="TIME", help=f"start at this time, {moment}")
    add("--until", type=_moment, metavar="TIME", help="stop at this time")
    add("--summary", action="store_true", help="show only the counters of each node")


def make_job(given: argparse.Namespace) -> "Callable[[object], DecodeReport]":
    """Check what was given and return the job."""
    job = Decoding(
        filter_=given_filter(given),
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
    """The user stopped it while it waited for input."""


def _readable(file: BinaryIO) -> bool:
    """Wait LOOK_S at most; true where nobody can wait for it."""
    try:
        return bool(select.select([file], [], [], LOOK_S)[0])
    except (OSError, ValueError):
        return True


class Decoding:
    """Decodes recordings one after the other, as one: blocks may begin in one and end in the next."""

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
        self._form = _json_line if as_json else line_of
        self._held: list[str] = []
        self._flag = StopFlag()

    def run(self, files: list[Path]) -> "DecodeReport":
        """Decode FILES; lines go to standard output, sentences about what is broken to the report."""
        with stop_flag() as self._flag:
            for file in files:
                if not self._flag.stopped:
                    self._decode(file)
            for bus in self.buses.values():
                self._take(bus.flush())
            self._write()
        return DecodeReport(self, stopped=self._flag.stopped, lines=self._shows)

    def _decode(self, file: Path) -> None:
        try:
            for frames in read_batches(file, self._wait_for_input if file == STANDARD_INPUT else None):
                if not self.frames:
                    self._set_limits(frames[0].time_s)
                if self._flag.stopped or self._feed(frames):
                    break
        except _StoppedError:
            pass
        except CanductorError as error:
            self.problems.append(str(error))

    def _wait_for_input(self) -> None:
        """Show what there is, and wait for a pipe so that Ctrl-C ends that and nothing else."""
        self._write()
        while not (self._flag.stopped or _readable(sys.stdin.buffer)):
            pass
        if self._flag.stopped:
            raise _StoppedError

    def _feed(self, frames: Sequence[Frame]) -> bool:
        """Decode FRAMES; return whether the end was reached.

        Step by step for all of them, not frame by frame: so each step stays in the processor's cache, which
        makes it a quarter faster.
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
                f"frame {self.frames}: more than {BUSES_MAX} buses in one recording; damaged?"
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
        sys.stdout.write("\n".join(self._held) + "\n")
        sys.stdout.flush()
        self._held.clear()


def _json_line(said: Decoded) -> str:
    return json.dumps({"time_s": said.time_s, **json_of(said)}, separators=(",", ":"))


class DecodeReport:
    """What was decoded: every node's counters, and what could not be read."""

    def __init__(self, decoding: Decoding, *, stopped: bool, lines: bool) -> None:
        self._decoding = decoding
        self._stopped = stopped
        self._lines = lines

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
            parts.append(f"\nbus {printable(name)}: {others}\n{table}")
        return "\n".join(parts)

    def _hints(self) -> list[str]:
        nodes = [node for bus in self._decoding.buses.values() for node in bus.nodes.values()]
        return [guess for node in nodes if (guess := node.guess)] + [
            f"node {node.nodeid}: {unread} of its blocks could not be read, its dictionary is not in the"
            f" recording; give it with --dictionary {node.nodeid}=FILE"
            for node in nodes
            if (unread := node.to_node.unknown_messages + node.from_node.unknown_messages)
            and not node.dictionary_origin
        ]

    @staticmethod
    def _warn(sentences: list[str]) -> None:
        sys.stdout.flush()
        for sentence in sentences:
            sys.stderr.write(f"canductor: {sentence}\n")
