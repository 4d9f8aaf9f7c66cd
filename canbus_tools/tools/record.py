"""``canductor can record``: a live bus into a file, MCAP with all that was said or a plain candump log."""

import argparse
import contextlib
import errno
import sys
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import BinaryIO, Final, Protocol

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
from nodes.support.option_values import UsageError, decimal, parse_path

LOOK_S: Final = 0.1
"""How soon Ctrl-C and the end of the time are noticed on a silent bus."""
DRAIN_S: Final = 1.0
"""At the end, frames that had arrived are still recorded: so long at most, on a bus that is never quiet."""
QUIET_S: Final = 0.02
COUNTERS_S: Final = 1.0
"""Between two entries of the counters, in the time of the frames."""
DURATION_MAX_S: Final = 1e7


class FrameFile(Protocol):
    """Where frames are recorded to."""

    def frame(self, frame: Frame) -> None:
        """Add a frame; raises OSError."""

    def finish(self) -> None:
        """Bring it to its end; the file remains open."""


def declare(command: argparse.ArgumentParser) -> None:
    """Add the options of the tool."""
    declare_bus(command)
    add = command.add_argument
    add(
        "-o",
        "--output",
        type=_output,
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
    """Check what was given and return the job."""
    path: Path = given.output
    if path.exists() and not given.force:
        raise UsageError(f"'{path}' exists already; --force overwrites it")
    options = bus_options(given)
    return lambda computer: record_bus(computer, options, path, given.duration, given.dictionaries)


def _output(text: str) -> Path:
    return parse_path(text, ".mcap", ".log")


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
        recorder = _recorder(path, file, dictionaries or {})
        sys.stderr.write(f"recording {options.name} to '{path}'; Ctrl-C ends it\n")
        sys.stderr.flush()
        try:
            for frame in _until_end(computer, bus, flag, duration_s):
                recorder.frame(frame)
                report.frames += 1
        finally:  # whatever ends it, the file is complete up to there
            recorder.finish()
            report.dropped = bus.dropped
    return report


def _until_end(
    computer: Computer, bus: Listener, flag: StopFlag, duration_s: float | None
) -> Iterator[Frame]:
    """Yield frames until the time is over or the user stops it, and then those that are on their way."""
    end_s = None if duration_s is None else now_s(computer) + duration_s
    while not flag.stopped:
        left_s = LOOK_S if end_s is None else min(LOOK_S, end_s - now_s(computer))
        if left_s <= 0:
            break
        yield from bus.take(left_s)
    yield from bus.rest(QUIET_S, DRAIN_S)


@contextlib.contextmanager
def _writing(path: Path, report: "RecordReport") -> Iterator[BinaryIO]:
    """Open the file; a disk that fails ends in one sentence."""
    try:
        with path.open("wb") as file:
            yield file
        report.size_bytes = path.stat().st_size
    except OSError as error:
        why = error.strerror or str(error)
        todo = "; make room, or record elsewhere" if error.errno == errno.ENOSPC else ""
        raise CanductorError(
            f"'{path}' cannot be written: {why}, after {report.frames} frames{todo}"
        ) from None


def _recorder(path: Path, file: BinaryIO, dictionaries: Mapping[int, Dictionary]) -> FrameFile:
    if path.suffix.lower() == ".log":
        return CandumpFile(file)
    return McapFile(file, BusDecoder(DictionarySource(dictionaries, DictionaryCache.of_user())))


class CandumpFile:
    """A candump log."""

    def __init__(self, file: BinaryIO) -> None:
        self._file = file

    def frame(self, frame: Frame) -> None:
        """Add a frame."""
        self._file.write(candump_line(frame).encode())

    def finish(self) -> None:
        """Write what is held back."""
        self._file.flush()


class McapFile:
    """Frames, what they say by DECODER, and its counters."""

    def __init__(self, file: BinaryIO, decoder: BusDecoder) -> None:
        self._writer = McapWriter(file)
        self._decoder = decoder
        self._frames = self._bytes = 0
        self._last_s = 0.0
        self._counted_s: float | None = None

    def frame(self, frame: Frame) -> None:
        """Add a frame and what it completes."""
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
        """Add what can still be read, the last counters and the index."""
        for said in self._decoder.flush():
            self._writer.said(said)
        self._count()
        self._writer.finish()

    def _count(self) -> None:
        self._counted_s = self._last_s
        nodes = [node.to_json() for _, node in sorted(self._decoder.nodes.items())]
        self._writer.counters(self._last_s, {"frames": self._frames, "bytes": self._bytes, "nodes": nodes})


class RecordReport:
    """What was recorded."""

    ok = True

    def __init__(self, path: Path, bus: str) -> None:
        self.path = path
        self.bus = bus
        self.frames = 0
        self.size_bytes = 0
        self.dropped = 0
        """Frames that came faster than they could be recorded."""

    def to_json(self) -> Mapping[str, object]:
        """Return file, frames and bytes."""
        return {
            "bus": self.bus,
            "file": str(self.path),
            "frames": self.frames,
            "bytes": self.size_bytes,
            "dropped_frames": self.dropped,
        }

    def to_text(self) -> str:
        """Return it as a sentence."""
        dropped = f"; {self.dropped} more came too fast and were dropped" if self.dropped else ""
        return (
            f"{self.frames} frames of {self.bus} recorded to '{self.path}' ({self.size_bytes} bytes){dropped}"
        )
