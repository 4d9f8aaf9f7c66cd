"""Kinds of replies, and how a line-oriented client reads each: as it is, ``// `` or ``!! ``."""

from enum import StrEnum
from typing import Final

INFORMATION_PREFIX: Final = "// "
ERROR_PREFIX: Final = "!! "
ACTION_PREFIX: Final = "// action:"


class ReplyKind(StrEnum):
    """What a reply is for."""

    PLAIN = "plain"
    """For programs: temperatures, positions, lists. Shown as it is."""
    INFORMATION = "information"
    """For people."""
    ERROR = "error"
    """Something failed."""
    ACTION = "action"
    """For the host program: prompts, pause, resume, cancel. The text begins with ``// action:`` already."""


def kind_of_line(line: str) -> ReplyKind:
    """Return the kind of a line that a program has written with its prefix (RESPOND, M118)."""
    if line.startswith(ACTION_PREFIX):
        return ReplyKind.ACTION
    return ReplyKind.ERROR if line.startswith(ERROR_PREFIX.strip()) else ReplyKind.PLAIN


def line_of(kind: ReplyKind, text: str) -> str:
    """Return TEXT of KIND with its prefix: each line of an information, the first line of an error."""
    if kind is ReplyKind.INFORMATION:
        return "\n".join(INFORMATION_PREFIX + line for line in text.split("\n"))
    if kind is ReplyKind.ERROR and not text.startswith(ERROR_PREFIX.strip()):
        return ERROR_PREFIX + text
    return text
