"""Reading recordings of CAN buses in various formats.

The readable frames of a damaged or truncated file are yielded; then a CanductorError reports the place.
"""

import os
from collections.abc import Callable, Iterator
from functools import partial
from io import BufferedReader, FileIO, TextIOWrapper
from pathlib import Path
from typing import Any, BinaryIO, Final

import can

from canbus_tools.protocol.frame import Frame
from canbus_tools.recordings import mcap_file, pcap
from canbus_tools.recordings.candump import read_candump
from nodes.support.errors import CanductorError
from nodes.support.option_values import existing_file
from nodes.support.standard_input import standard_input

STANDARD_INPUT: Final = Path("-")
BATCH: Final = 512
_BLF_MAGIC: Final = b"LOGG"
_ASC_BEGINNINGS: Final = (b"date ", b"base ", b"// ", b"begin ", b"internal ")
_MAGIC_SIZE: Final = 16
_TIME_END_S: Final = 1e12

BeforeRead = Callable[[BinaryIO | FileIO], object]


def read_frames(path: Path) -> Iterator[Frame]:
    """Yield the frames of a file in its order; raises CanductorError.

    Recognises candump logs, BLF, ASC, pcap, pcapng and MCAP by their content. PATH ``-``: a candump log from
    standard input.
    """
    for frames in read_batches(path):
        yield from frames


def read_batches(path: Path, before_read: BeforeRead | None = None) -> Iterator[list[Frame]]:
    """Yield the frames as read_frames does, but in lists, which is faster.

    BEFORE_READ gets what is about to be read where that may have to be waited for: a pipe, standard input.
    """
    if path == STANDARD_INPUT:
        source = standard_input().buffer
        wait = None if before_read is None else partial(before_read, source)
        yield from read_candump(source, "standard input", wait)
        return
    existing_file(path)
    try:
        with path.open("rb") if before_read is None else _open_patiently(path, before_read) as file:
            reader = _reader(file, path)
            if reader is None:
                yield from read_candump(file, str(path))
            else:
                yield from _in_batches(reader(file, str(path)))
    except OSError as error:
        raise CanductorError(f"{path}: cannot be read: {error.strerror or error}") from None


class _AwaitedFile(FileIO):
    """A file of which each read has to be waited for, and is announced to BEFORE_READ."""

    def __init__(self, fd: int, before_read: BeforeRead) -> None:
        super().__init__(fd)
        self._before_read = before_read

    def readinto(self, buffer: Any, /) -> int | None:
        """Do as FileIO does."""
        self._before_read(self)
        return super().readinto(buffer)


def _open_patiently(path: Path, before_read: BeforeRead) -> BufferedReader:
    """Open PATH without waiting for who writes into it, if it is a pipe: BEFORE_READ does; raises OSError."""
    if path.is_file():
        return path.open("rb")
    fd = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
    return BufferedReader(_AwaitedFile(fd, before_read))


def _in_batches(frames: Iterator[Frame]) -> Iterator[list[Frame]]:
    """Yield lists of up to BATCH frames; frames before an error are yielded before it is raised."""
    batch: list[Frame] = []
    try:
        for frame in frames:
            batch.append(frame)
            if len(batch) == BATCH:
                yield batch
                batch = []
    except CanductorError:
        if batch:
            yield batch
        raise
    if batch:
        yield batch


def _reader(file: BufferedReader, path: Path) -> Callable[[BinaryIO, str], Iterator[Frame]] | None:
    """Return the reader for a file; None: it is read as a candump log."""
    start = file.peek(_MAGIC_SIZE)[:_MAGIC_SIZE]
    if start[:4] in pcap.PCAP_MAGICS:
        return pcap.read_pcap
    if start[:4] == pcap.PCAPNG_MAGIC:
        return pcap.read_pcapng
    if start.startswith(mcap_file.MAGIC):
        return mcap_file.read_mcap
    if start.startswith(_BLF_MAGIC):
        return _read_blf
    if start.lower().startswith(_ASC_BEGINNINGS) or path.suffix.lower() == ".asc":
        return _read_asc
    if not start:
        raise CanductorError(f"{path}: is empty")
    if b"\0" in start:
        raise CanductorError(
            f"{path}: unknown format; candump logs, BLF, ASC, pcap, pcapng and MCAP can be read"
        )
    return None


def _read_blf(source: BinaryIO, name: str) -> Iterator[Frame]:
    readers: list[can.BLFReader] = []

    def open_reader() -> can.BLFReader:
        readers.append(can.BLFReader(source))
        return readers[0]

    size = Path(name).stat().st_size
    yield from _read_python_can(open_reader, name)
    # A truncated container inflates to what there is of it, without an error.
    if readers[0].file_size > size:
        raise CanductorError(
            f"{name}: truncated at byte {size} of {readers[0].file_size}; the frames before were read"
        )


def _read_asc(source: BinaryIO, name: str) -> Iterator[Frame]:
    text = TextIOWrapper(source, encoding="utf-8", errors="replace")
    yield from _read_python_can(lambda: can.ASCReader(text), name)


def _read_python_can(open_reader: Callable[[], can.BLFReader | can.ASCReader], name: str) -> Iterator[Frame]:
    count = 0
    try:
        for message in open_reader():
            frame = Frame.from_message(message)
            if 0 <= frame.time_s < _TIME_END_S:
                yield frame
                count += 1
    # Its readers raise various errors for damaged files: struct.error, zlib.error, KeyError, …
    except Exception as error:
        said = " ".join(str(error).split()) or type(error).__name__
        raise CanductorError(
            f"{name}: damaged or truncated after frame {count} ({said}); the frames before were read"
        ) from error
