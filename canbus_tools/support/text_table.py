"""Plain text: tables with columns aligned by spaces, counts and paragraphs."""

import re
import textwrap
from collections.abc import Sequence
from typing import Final

WIDTH: Final = 98
_HARD_SPACE: Final = "\0"


def table(headings: Sequence[str], rows: Sequence[Sequence[str]], indent: str = "  ") -> list[str]:
    """Return the lines of a table; columns whose cells are all empty are omitted."""
    kept = [n for n in range(len(headings)) if any(row[n] for row in rows) or not rows]
    lines = [[row[n] for n in kept] for row in (headings, *rows)]
    widths = [max(len(line[n]) for line in lines) for n in range(len(kept))]
    return [
        (indent + "  ".join(f"{cell:{width}}" for cell, width in zip(line, widths, strict=True))).rstrip()
        for line in lines
    ]


def count(number: int, what: str, several: str = "") -> str:
    """Return ``1 node``, ``2 nodes``; SEVERAL: the plural, if it is not WHAT with an ``s``."""
    return f"{number} {what if number == 1 else several or what + 's'}"


def paragraph(text: str) -> list[str]:
    """Return TEXT wrapped for a terminal; a quoted command stays on one line, so that it can be copied."""
    kept = re.sub(r"'canductor [^']*'", lambda command: command[0].replace(" ", _HARD_SPACE), text)
    lines = textwrap.wrap(kept, WIDTH, break_long_words=False, break_on_hyphens=False)
    return [line.replace(_HARD_SPACE, " ") for line in lines]
