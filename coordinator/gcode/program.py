"""The text of a G-code program, read in bounded pieces: memory does not grow with its length."""

import os
import select
import stat
from collections.abc import Callable, Iterable, Iterator
from io import FileIO
from pathlib import Path
from types import TracebackType
from typing import Protocol, Self

from coordinator.gcode.errors import GCodeError
from nodes.support.errors import CanductorError
from nodes.support.standard_input import standard_input

CHUNK_BYTES = 1 << 16
MAX_LINE_BYTES = 1 << 20
"""A longer line is not G-code; comments with pictures in them stay far below."""
_BYTE_ORDER_MARK = b"\xef\xbb\xbf"


class ByteSource(Protocol):
    """What a program is read from: an open binary file, a pipe, standard input."""

    def read(self, size: int, /) -> bytes | None:
        """Return at most SIZE bytes; none at the end; None when nothing has come yet."""

    def close(self) -> None:
        """Release it."""


class UnchangedFile(FileIO):
    """A file whose content stays as it was when it was opened: what was changed since is never returned.

    A pipe, which has no content of its own, is read as it comes.
    """

    def __init__(self, file: str | Path | int, name: str) -> None:
        super().__init__(file)
        self._shown = name
        self.status = os.fstat(self.fileno())

    def read(self, size: int | None = -1, /) -> bytes | None:  # type: ignore[override]  # as FileIO does
        """Return what follows; raises CanductorError once the file was changed, OSError."""
        piece = super().read(size)
        now = os.fstat(self.fileno())
        if stat.S_ISREG(now.st_mode) and _content_stamp(now) != _content_stamp(self.status):
            how = f"truncated to {now.st_size:,} bytes" if now.st_size < self.status.st_size else "changed"
            raise CanductorError(
                f"{self._shown} was {how} while it was being printed; what was read before was carried out,"
                " the rest was not"
            )
        return piece


def _content_stamp(status: os.stat_result) -> tuple[int, int]:
    return status.st_size, status.st_mtime_ns


class _Pieces:
    """Lines (or larger pieces) of text as a byte source; a line feed is added where one is missing."""

    def __init__(self, pieces: Iterable[str | bytes]) -> None:
        self._pieces: Iterator[str | bytes] = iter(pieces)

    def read(self, _size: int, /) -> bytes:
        for piece in self._pieces:
            data = piece.encode(errors="surrogateescape") if isinstance(piece, str) else bytes(piece)
            return data if data.endswith(b"\n") else data + b"\n"
        return b""

    def close(self) -> None:
        """Nothing to release."""


class _Typed:
    """Standard input as it comes: a read never waits, and leaves the terminal's settings alone."""

    def __init__(self, fd: int) -> None:
        self._fd = fd
        self._poll = select.poll()
        self._poll.register(fd, select.POLLIN)

    def read(self, size: int, /) -> bytes | None:
        return os.read(self._fd, size) if self._poll.poll(0) else None

    def close(self) -> None:
        """Leave standard input open."""


def _ignore(_piece: bytes, _place: int) -> None:
    pass


class Program:
    """A program with a window on its text: ``data[start:]`` is what was not consumed yet.

    The owner of the window moves ``start`` on and calls ``refill`` when no whole line is left.
    """

    def __init__(
        self, source: ByteSource, name: str, *, size_bytes: int | None = None, modified_ns: int = 0
    ) -> None:
        self.name = name
        self.size_bytes = size_bytes
        """None where it is not known (pipes)."""
        self.modified_ns = modified_ns
        """When the file was written last, since the epoch; 0: not known."""
        self.data = b""
        self.start = 0
        self.final = False
        """Whether the window reaches the end of the program."""
        self.end_bytes: int | None = None
        """Where reading ends, if before the end of the file."""
        self.on_piece: Callable[[bytes, int], None] = _ignore
        """Called with each piece that is read and its place, in the thread that reads."""
        self._source = source
        self._read_bytes = 0

    @classmethod
    def open(cls, path: str | Path) -> Self:
        """Open the file PATH, or standard input for ``-``. Raises CanductorError when that fails."""
        if str(path) == "-":
            # Unbuffered: what a person or a program typed is acted on at once, not when a block is full.
            return cls(FileIO(standard_input().fileno(), closefd=False), "standard input")
        try:
            source = UnchangedFile(path, str(path))
            size = source.status.st_size if stat.S_ISREG(source.status.st_mode) else None
        except OSError as error:
            reason = (error.strerror or str(error)).lower()
            raise CanductorError(f"cannot read the G-code file {path}: {reason}; check the path") from error
        return cls(source, str(path), size_bytes=size)

    @classmethod
    def typed(cls) -> Self:
        """Read standard input as it comes, without ever waiting for it; raises CanductorError."""
        return cls(_Typed(standard_input().fileno()), "standard input")

    @classmethod
    def from_lines(cls, lines: Iterable[str | bytes], name: str = "program") -> Self:
        """Read from LINES, with or without line feeds."""
        return cls(_Pieces(lines), name)

    @property
    def done_bytes(self) -> int:
        """Bytes consumed."""
        return self._read_bytes - (len(self.data) - self.start)

    def refill(self) -> bool:
        """Drop what was consumed and read one piece more; False when the source has nothing yet.

        Raises CanductorError when reading fails or a line is longer than MAX_LINE_BYTES.
        """
        try:
            left = CHUNK_BYTES if self.end_bytes is None else self.end_bytes - self._read_bytes
            piece = self._source.read(min(CHUNK_BYTES, left)) if left > 0 else b""
        except OSError as error:
            reason = (error.strerror or str(error)).lower()
            raise CanductorError(f"reading {self.name} failed: {reason}; copy the file again") from error
        if piece is None:
            return False
        if self._read_bytes == 0 and piece.startswith(_BYTE_ORDER_MARK):
            self._read_bytes = len(_BYTE_ORDER_MARK)
            piece = piece[len(_BYTE_ORDER_MARK) :]
            self.final = False
        else:
            self.final = not piece
        self.on_piece(piece, self._read_bytes)
        self._read_bytes += len(piece)
        self.data = self.data[self.start :] + piece
        self.start = 0
        return True

    def skip_lines(self, count: int) -> bool:
        """Go on behind the next COUNT lines; False when there are fewer. Raises CanductorError."""
        for _ in range(count):
            while (end := self.data.find(b"\n", self.start)) < 0:
                self.check_line_length(0)
                if self.final or not self.refill():
                    return False
            self.start = end + 1
        return True

    def line_end(self) -> int:
        """Return where the line at ``start`` ends, line feed excluded."""
        end = self.data.find(b"\n", self.start)
        return len(self.data) if end < 0 else end

    def check_line_length(self, line: int) -> None:
        """Raise GCodeError when the window holds nothing but an endless LINE."""
        if len(self.data) - self.start > MAX_LINE_BYTES:
            raise GCodeError(
                self.name, line, f"this line is longer than {MAX_LINE_BYTES} bytes; is this a G-code file?"
            )

    def close(self) -> None:
        """Close the source."""
        self._source.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()
