"""What is shown to people: the one place that writes to a terminal, or to the log that a terminal shows.

Names and texts come from files, clients and wires. A terminal obeys control characters in them, a log gets
lines that nobody wrote, and a change of direction makes a name look like another. So each unprintable
character is replaced, by the same functions, on all ways out.
"""

import contextlib
import os
import sys
from typing import Final, Self, TextIO

_STANDARD_FILES: Final = (0, 1, 2)
_KEPT: Final = "\n\t"
REPLACEMENT: Final = "?"


class OutputError(OSError):
    """Standard output takes nothing, such as a file on a full disk; a sentence."""

    @classmethod
    def of(cls, error: OSError) -> Self:
        """Make it of what was raised by the system."""
        return cls(f"cannot write the output: {(error.strerror or str(error)).lower()}")


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

    BEFORE moves the cursor of a terminal; it never comes from outside. Raises BrokenPipeError when the reader
    is gone, else OutputError; in that case all that is written to STREAM later goes nowhere.
    """
    stream = sys.stdout if stream is None else stream
    try:
        stream.write(before + printable_lines(text) + end)
        stream.flush()
    except BrokenPipeError:
        raise
    except OSError as error:
        discard(stream)
        raise OutputError.of(error) from None


def show_error(text: str, stream: TextIO | None = None) -> None:
    """Write the line TEXT to STREAM (None: standard error) at once; without effect where nothing takes it."""
    stream = sys.stderr if stream is None else stream
    try:
        show(text, stream)
    except BrokenPipeError:
        discard(stream)
    except OutputError:
        pass


def discard(stream: TextIO) -> None:
    """Have all go nowhere that STREAM still holds or gets; else the interpreter complains when it exits."""
    with contextlib.suppress(OSError):  # it is no file
        descriptor, nothing = stream.fileno(), os.open(os.devnull, os.O_WRONLY)
        os.dup2(nothing, descriptor)
        os.close(nothing)


def replace_closed_outputs() -> None:
    """Have output go nowhere that the program was started without: there is nobody to read it.

    The descriptors of all standard files are taken, so that no connection to a node becomes one of them.
    """
    while (descriptor := os.open(os.devnull, os.O_RDWR)) in _STANDARD_FILES:
        os.set_inheritable(descriptor, True)
    os.close(descriptor)
    for number, name in ((1, "stdout"), (2, "stderr")):
        if getattr(sys, name) is None:
            setattr(sys, name, os.fdopen(number, "w", encoding="utf-8", closefd=False))
