"""Where the lines of a job's file begin, for its progress: from the line carried out to the last one read."""

import re
from array import array
from bisect import bisect_left
from dataclasses import dataclass
from typing import Final

LINES_MAX: Final = 1 << 18
"""Lines between what is carried out and what is read whose ends are kept (1 MB); those of further pieces are
estimated. Only files that consist of comments are read so far ahead."""
_LINE_FEED: Final = re.compile(rb"\n")


@dataclass(frozen=True, slots=True)
class _Piece:
    first: int
    """Number of line ends before it, since the beginning."""
    begin: int
    """Place of its first byte in the file."""
    size: int
    count: int
    """Line ends in it."""
    ends: "array[int] | None"
    """Where they are, from its first byte; None: not kept."""

    def end_of(self, index: int) -> int:
        """Return the place behind line end INDEX, counted since the beginning."""
        at = index - self.first
        if self.ends is not None:
            return self.begin + self.ends[at] + 1
        return self.begin + (at + 1) * self.size // self.count

    def count_before(self, place: int) -> int:
        """Return how many line ends, since the beginning, lie before PLACE."""
        inside = min(max(place - self.begin, 0), self.size)
        if self.ends is not None:
            return self.first + bisect_left(self.ends, inside)
        return self.first + inside * self.count // max(1, self.size)


class FilePlaces:
    """Follows the pieces in which a file is read; the first begins with a line.

    ``add`` may be called from one other thread than the rest.
    """

    def __init__(self) -> None:
        self._pieces: list[_Piece] = []
        self._lines_before: int | None = None
        """Lines of the file before the first piece."""

    def add(self, piece: bytes, begin: int) -> None:
        """Take note of PIECE, whose first byte is at BEGIN; pieces come in order, without gaps."""
        ends = array("I", (found.start() for found in _LINE_FEED.finditer(piece)))
        last = self._pieces[-1] if self._pieces else None
        first = last.first + last.count if last is not None else 0
        kept = first - (self._pieces[0].first if self._pieces else 0) + len(ends) <= LINES_MAX
        self._pieces.append(_Piece(first, begin, len(piece), len(ends), ends if kept else None))

    def read(self, lines: int, place: int) -> None:
        """Record that the reader counts LINES and is at PLACE, behind a line."""
        count, whole = self._count_before(place)
        if whole:
            # The line of a macro is counted when its own lines are done; the reader is behind it before.
            before = lines - count
            self._lines_before = before if self._lines_before is None else max(self._lines_before, before)

    def begin_of(self, line: int) -> int | None:
        """Return where LINE (from 1) begins; None when that is not known (any more)."""
        if self._lines_before is None:
            return None
        index = line - 2 - self._lines_before  # of the line end before it
        pieces = self._pieces
        if index < 0:
            return pieces[0].begin if pieces and index == -1 and pieces[0].first == 0 else None
        for piece in pieces:
            if piece.first <= index < piece.first + piece.count:
                return piece.end_of(index)
        return None

    def begin_before(self, place: int) -> int | None:
        """Return where the line begins that ends right before PLACE, or at the end of the file."""
        if self._lines_before is None:
            return None
        count, whole = self._count_before(place)
        return self.begin_of(count + (not whole) + self._lines_before)

    def forget_before(self, place: int) -> None:
        """Keep nothing of pieces that end before PLACE."""
        pieces = self._pieces
        while len(pieces) > 2 and pieces[1].begin < place:
            del pieces[0]

    def _count_before(self, place: int) -> tuple[int, bool]:
        """Return how many line ends lie before PLACE, and whether a line begins there."""
        count, whole = 0, True
        for piece in tuple(self._pieces):
            if piece.begin >= place:
                break
            count = piece.count_before(place)
            ended = count > piece.first and piece.end_of(count - 1) == place
            whole = piece.ends is None or ended
        return count, whole
