"""The directory of a peripheral: lines of text, without a block check.

Four lines are ignored. Each further line has six characters that are ignored, a name, blanks, the number of
sectors, and text that is ignored. The last line is ``FREE:`` and a number of sectors.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Final

from coordinator.dnc.files import Entry
from nodes.support.errors import CanductorError

SECTOR_BYTES: Final = 512
_IGNORED_LINES: Final = 4
_IGNORED_CHARACTERS: Final = 6


@dataclass(frozen=True, slots=True)
class Listing:
    """The content of a directory."""

    sectors: dict[str, int]
    """By name."""
    free_sectors: int | None


def write_listing(entries: Iterable[Entry], free_bytes: int) -> bytes:
    """Return the directory of ENTRIES; names with blanks are left out, since they could not be parsed."""
    lines = ["", "      CANDUCTOR", "", ""]
    for entry in entries:
        if " " not in entry.name:
            sectors = -(-entry.size_bytes // SECTOR_BYTES)
            lines.append(f"      {entry.name:<24} {sectors:>7} {entry.code}")
    lines.append(f"      FREE: {min(free_bytes // SECTOR_BYTES, 9_999_999)}")
    return "".join(line + "\r\n" for line in lines).encode("ascii")


def read_listing(text: bytes) -> Listing:
    """Parse a directory; raises CanductorError."""
    if any(c > 0x7E or (c < 0x20 and c not in b"\r\n\t") for c in text):
        raise CanductorError(
            "the directory was received damaged; check baud rate and parity, and request it again"
        )
    sectors: dict[str, int] = {}
    free = None
    for line in text.decode("ascii").split("\n")[_IGNORED_LINES:]:
        before, found, after = line.partition("FREE:")
        words = (after if found else line[_IGNORED_CHARACTERS:]).split()
        if found:
            free = int(words[0]) if words and words[0].isdecimal() else None
        elif words:
            sectors[words[0]] = (
                int(words[1]) if words[1:] and words[1].isdecimal() and len(words[1]) < 10 else 0
            )
        del before
    return Listing(sectors, free)
