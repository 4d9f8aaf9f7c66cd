"""What is shown to people: the one place that writes to a terminal, or to the log that a terminal shows.

Names and texts come from files, clients and wires. A terminal obeys control characters in them, a log gets
lines that nobody wrote, and a change of direction makes a name look like another. So each unprintable
character is replaced, by the same functions, on all ways out.
"""

import sys
from typing import Final, TextIO

_KEPT: Final = "\n\t"
REPLACEMENT: Final = "?"


def printable(text: str) -> str:
    """Return TEXT as one line: each unprintable character is replaced, line feeds and tabs included."""
    if text.isprintable():
        return text
    return "".join(c if c.isprintable() else REPLACEMENT for c in text)


def printable_lines(text: str) -> str:
    """Return TEXT with each character replaced that is neither printable nor a line feed or tab."""
    if text.isprintable() or text.translate(_WITHOUT_KEPT).isprintable():
        return text
    return "".join(c if c.isprintable() or c in _KEPT else REPLACEMENT for c in text)


_WITHOUT_KEPT: Final = dict.fromkeys(map(ord, _KEPT))


def show(text: str, stream: TextIO | None = None, *, before: str = "", end: str = "\n") -> None:
    """Write TEXT and END to STREAM (None: standard output) at once.

    BEFORE moves the cursor of a terminal; it never comes from outside.
    """
    stream = sys.stdout if stream is None else stream
    stream.write(before + printable_lines(text) + end)
    stream.flush()


def show_error(text: str) -> None:
    """Write the line TEXT to standard error at once."""
    show(text, sys.stderr)
