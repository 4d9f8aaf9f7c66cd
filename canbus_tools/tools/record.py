"""``canductor can record``: records a bus to a file: MCAP with decoded messages, or a candump log."""

import argparse
import contextlib
import errno
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO, Final

from canbus_tools.bus.computer import Computer, Listener, now_s
from canbus_tools.bus.open_bus import BusOptions, bus_options, declare_bus
from canbus_tools.bus.until_stopped import StopFlag, stop_flag
from canbus_tools.protocol.decoder import BusDecoder
from canbus_tools.protocol.dictionaries import DictionarySource, declare_dictionaries
from canbus_tools.protocol.frame import Frame
from canbus_tools.recordings.candump import candump_line
from canbus_tools.recordings.mcap_file import McapWriter
from nodes.dictionary.cache import DictionaryCache
from nodes.dictionary.dictionary import Dictionary
from nodes.support.errors import CanductorError
from nodes.support.file_kind import exists
from nodes.support.option_values import UsageError, decimal, parse_path
from nodes.support.terminal import show_error

LOOK_S: Final = 0.1
"""Interval of checks for Ctrl-C and the end of the time on a silent bus."""
DRAIN_S: Final = 1.0
"""Longest time at the end for recording frames that have arrived already."""
QUIET_S: Final = 0.02
COUNTERS_S: Final = 1.0
"""Interval of the counters' entries, in the time of the frames."""
DURATION_MAX_S: Final = 1e7


def declare(command: argparse.ArgumentParser) -> None:
    """Add the options."""
    declare_bus(command)
    add = command.add_argument
    add(
        "-o",
        "--output",
        type=lambda text: parse_path(text, ".mcap", ".log"),
        metavar="FILE",
        required=True,
        help="file to write: FILE.mcap, or FILE.log for a candump log",
    )
    add(
        "--duration",
        type=decimal(0.1, DURATION_MAX_S, "s"),
        metavar="S",
        help="stop after this many seconds (default: at Ctrl-C)",
    )
    add("--force", action="store_true", help="overwrite an existing file")
    declare_dictionaries(command)


def make_job(given: argparse.Namespace) -> "Callable[[Computer], RecordReport]":
    """Return the job; raises UsageError, CanductorError."""
    path: Path = given.output
    if exists(path) and not given.force:
        raise UsageError(f"'{path}' exists already; give --force to overwrite it")
    options = bus_options(given)
    return lambda computer: record_bus(computer, options, path, given.duration, given.dictionaries)


def record_bus(
    computer: Computer,
    options: BusOptions,
    path: Path,
    duration_s: float | None = None,
    dictionaries: Mapping[int, Dictionary] | None = None,
) -> "RecordReport":
    """Record the bus until DURATION_S is over or Ctrl-C; raises CanductorError."""
    report = RecordReport(path, options.name)
    with (
        stop_flag() as flag,
        computer.listen(options) as bus,
        _writing(path, report) as file,
    ):
        decoder = BusDecoder(DictionarySource(dictionaries, DictionaryCache.of_user()))
        log = path.suffix.lower() == ".log"
        recorder = CandumpFile(file) if log else McapFile(file, decoder)
        show_error(f"recording {options.name} to '{path}'; Ctrl-C ends it")
        try:
            for frame in _until_end(computer, bus, flag, duration_s):
                recorder.frame(frame)
                report.frames += 1
        finally:  # whatever ends the recording, the file is valid
            recorder.finish()
            report.dropped = bus.dropped
    return report


def _until_end(
    computer: Computer, bus: Listener, flag: StopFlag, duration_s: float | None
) -> Iterator[Frame]:
    """Yield frames until the time is over or the user stops it, then those that have arrived already."""
    end_s = None if duration_s is None else now_s(computer) + duration_s
    while not flag.stopped:
        left_s = LOOK_S if end_s is None else min(LOOK_S, end_s - now_s(computer))
        if left_s <= 0:
            break
        yield from bus.take(left_s)
    yield from bus.rest(QUIET_S, DRAIN_S)


@contextlib.contextmanager
def _writing(path: Path, report: "RecordReport") -> Iterator[BinaryIO]:
    """Open the file; raises CanductorError when writing fails."""
    try:
        with path.open("wb") as file:
            yield file
        report.size_bytes = path.stat().st_size
    except OSError as error:
        why = error.strerror or str(error)
        todo = "; free some space, or record elsewhere" if error.errno == errno.ENOSPC else ""
        raise CanductorError(f"writing '{path}' failed after {report.frames} frames: {why}{todo}") from None


class CandumpFile:
    """A candump log."""

    def __init__(self, file: BinaryIO) -> None:
        self._file = file

    def frame(self, frame: Frame) -> None:
        """Add a frame."""
        self._file.write(candump_line(frame).encode())

    def finish(self) -> None:
        """Write buffered lines."""
        self._file.flush()


class McapFile:
    """An MCAP file with frames, messages decoded by DECODER, and its counters."""

    def __init__(self, file: BinaryIO, decoder: BusDecoder) -> None:
        self._writer = McapWriter(file)
        self._decoder = decoder
        self._frames = self._bytes = 0
        self._last_s = 0.0
        self._counted_s: float | None = None

    def frame(self, frame: Frame) -> None:
        """Add a frame and the messages that it completes."""
        self._writer.frame(frame)
        self._frames += 1
        self._bytes += len(frame.data)
        for said in self._decoder.feed(frame):
            self._writer.said(said)
        self._last_s = frame.time_s
        if self._counted_s is None:
            self._counted_s = frame.time_s
        elif not 0 <= frame.time_s - self._counted_s < COUNTERS_S:
            self._count()

    def finish(self) -> None:
        """Add the last messages, the last counters and the index."""
        for said in self._decoder.flush():
            self._writer.said(said)
        self._count()
        self._writer.finish()

    def _count(self) -> None:
        self._counted_s = self._last_s
        nodes = [node.to_json() for _, node in sorted(self._decoder.nodes.items())]
        self._writer.counters(self._last_s, {"frames": self._frames, "bytes": self._bytes, "nodes": nodes})


@dataclass(slots=True)
class RecordReport:
    """Figures of a recording."""

    path: Path
    bus: str
    frames: int = 0
    size_bytes: int = 0
    dropped: int = 0
    """Frames that arrived faster than they could be recorded."""
    ok: bool = True

    def to_json(self) -> Mapping[str, object]:
        """Return the figures."""
        return {
            "bus": self.bus,
            "file": str(self.path),
            "frames": self.frames,
            "bytes": self.size_bytes,
            "dropped_frames": self.dropped,
        }

    def to_text(self) -> str:
        """Return the figures as a sentence."""
        dropped = f"; {self.dropped} further frames arrived too fast and were dropped" if self.dropped else ""
        return (
            f"{self.frames} frames of {self.bus} recorded to '{self.path}' ({self.size_bytes} bytes){dropped}"
        )
