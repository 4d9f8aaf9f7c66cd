"""Plain tables: columns lined up by spaces, so that they read in any terminal, log or issue."""

import re
import textwrap
from collections.abc import Sequence
from typing import Final

WIDTH: Final = 98
_HARD_SPACE: Final = "\0"


def table(headings: Sequence[str], rows: Sequence[Sequence[str]], indent: str = "  ") -> list[str]:
    """Return the lines of a table; a column in which every row is empty is left out."""
    kept = [n for n in range(len(headings)) if any(row[n] for row in rows)]
    lines = [[row[n] for n in kept] for row in (headings, *rows)]
    widths = [max(len(line[n]) for line in lines) for n in range(len(kept))]
    return [
        (indent + "  ".join(f"{cell:{width}}" for cell, width in zip(line, widths, strict=True))).rstrip()
        for line in lines
    ]


def count(number: int, what: str, several: str = "") -> str:
    """Return ``1 node``, ``2 nodes``; SEVERAL when the plural is no mere ``s``."""
    return f"{number} {what if number == 1 else several or what + 's'}"


def paragraph(text: str) -> list[str]:
    """Return TEXT as lines that a terminal shows whole; a command in quotes is kept in one, to be copied."""
    kept = re.sub(r"'canductor [^']*'", lambda command: command[0].replace(" ", _HARD_SPACE), text)
    lines = textwrap.wrap(kept, WIDTH, break_long_words=False, break_on_hyphens=False)
    return [line.replace(_HARD_SPACE, " ") for line in lines]
