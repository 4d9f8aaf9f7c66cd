"""Line numbers of a program, which reveal a block that was received twice or lost.

Blocks have no numbers. The lines of dialog programs, which begin with ``0 BEGIN PGM``, are numbered in
steps of 1 and end with END PGM. N words of ISO programs are arbitrary unless they are declared even; but no
program has the same numbered line twice in a row.
"""

import re
from typing import Final

from coordinator.dnc.endpoint import Sink, Take
from coordinator.dnc.files import FileRefused

_DIALOG: Final = re.compile(rb"\s*0\s+BEGIN PGM\b")
_DIALOG_END: Final = re.compile(rb"\s*\d+\s+END PGM\b")
_DIALOG_NUMBER: Final = re.compile(rb"\s*(\d{1,9})(?=\s|$)")
_N_WORD: Final = re.compile(rb"\s*(?:/\s*)?[Nn](\d{1,9})(?!\d)")


class LineNumbers:
    """The numbers of the lines of a program called NAME; EVEN: its N words increase by the same step."""

    def __init__(self, name: str, *, even: bool = False) -> None:
        self._name = name
        self._even = even
        self._lines = 0
        self._dialog = False
        self._before = b""
        self._number: int | None = None
        self._step: int | None = None

    def check(self, line: bytes) -> None:
        """Record LINE; raises FileRefused if it cannot follow the lines before."""
        self._lines += 1
        if self._lines == 1:
            self._dialog = _DIALOG.match(line) is not None
        found = (_DIALOG_NUMBER if self._dialog else _N_WORD).match(line)
        if found is not None:
            number = int(found[1])
            if not self._dialog and line == self._before:
                raise self._refused(f"was received twice (N{number}), or a line is missing")
            self._check_step(number)
            self._number = number
        self._before = line

    def end(self) -> None:
        """Raise FileRefused if the program cannot end here."""
        if self._dialog and not _DIALOG_END.match(self._before):
            raise FileRefused(
                f"{self._name} has no END PGM: its end is missing; send the file again", "NO END PGM"
            )

    def _check_step(self, number: int) -> None:
        if self._number is None:
            return
        step = number - self._number
        wanted = 1 if self._dialog else self._step
        if self._dialog or self._even:
            if step <= 0 or wanted not in (None, step):
                raise self._refused(f"has number {number}, after {self._number}")
            self._step = step

    def _refused(self, what: str) -> FileRefused:
        return FileRefused(
            f"line {self._lines} of {self._name} {what}: a line was received twice or lost;"
            " send the file again",
            "WRONG LINE NUMBER",
        )


class NumberedSink:
    """SINK with a check of the line numbers. A ``Sink``."""

    def __init__(self, sink: Sink, *, even: bool = False) -> None:
        self._sink = sink
        self._numbers = LineNumbers(sink.name, even=even)
        self.name = sink.name
        self.size_bytes = 0
        self.is_live = sink.is_live

    @property
    def ready(self) -> bool:
        """See Sink."""
        return self._sink.ready

    def write(self, line: bytes) -> None:
        """See Sink."""
        self._numbers.check(line)
        self._sink.write(line)
        self.size_bytes = self._sink.size_bytes

    def keep(self) -> None:
        """See Sink."""
        self._numbers.end()
        self._sink.keep()

    def drop(self, why: str = "") -> None:
        """See Sink."""
        self._sink.drop(why)


def numbered(take: Take, *, even: bool) -> Take:
    """Return TAKE with a check of the line numbers."""
    return lambda header: NumberedSink(take(header), even=even)
