"""Quotes what a user wrote inside a message, and suggests the name that was meant."""

import difflib
from collections.abc import Iterable

_SHOWN_CHARS = 60
_SHOWN_PATH_CHARS = 300


def shown(text: str) -> str:
    """Quote what the user wrote so that it fits into a sentence: one line, printable, not long."""
    line = " ".join(text.split())
    if len(line) > _SHOWN_CHARS:
        line = line[: _SHOWN_CHARS - 1] + "…"
    return "'" + "".join(c if c.isprintable() else "?" for c in line) + "'"


def shown_path(path: str) -> str:
    """Quote a path; of a long one the end is shown."""
    line = "".join(c if c.isprintable() else "?" for c in path)
    return f"'{line}'" if len(line) <= _SHOWN_PATH_CHARS else f"'…{line[-_SHOWN_PATH_CHARS:]}'"


def printable(line: str) -> str:
    """Return LINE with a space for each tab and ? for what controls a terminal or nobody can print."""
    if line.isprintable():
        return line
    return "".join(c if c.isprintable() else " " if c == "\t" else "?" for c in line)


def nearest(word: str, valid: Iterable[str], *, pattern: str = "{}") -> str:
    """Return "; did you mean …?" when one of the valid names looks like the word, else nothing."""
    if len(word) > _SHOWN_CHARS:
        return ""
    lower = {name.lower(): name for name in valid}
    found = difflib.get_close_matches(word.lower(), lower, n=1, cutoff=0.6)
    return f"; did you mean {pattern.format(lower[found[0]])}?" if found else ""


def nearest_or_all(word: str, valid: Iterable[str], *, pattern: str = "{}") -> str:
    """Return the valid name that looks like the word as ``nearest`` does, else all of them."""
    names = tuple(valid)
    return nearest(word, names, pattern=pattern) or f"; there is {', '.join(names) or 'none'}"
