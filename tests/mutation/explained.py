"""equivalent.toml: survivors that no test can kill, each with the reason.

An entry names the file, the text of the source line without the blanks around it, the change as the report
prints it ("< -> <="), the reason, and the line above where several lines read the same; so it stays true when
lines move, and is stale when the line changes.
"""

import tomllib
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from tests.mutation.mutation import Mutation

LIST: Final = Path(__file__).with_name("equivalent.toml")


@dataclass(frozen=True, slots=True)
class Explained:
    """A change that makes no difference which anything could observe."""

    file: str
    line: str
    change: str
    reason: str
    above: str | None = None
    """The text of the line above, where several lines read the same; None: any."""

    def matches(self, mutation: Mutation) -> bool:
        """Whether MUTATION is this change."""
        here = mutation.above if self.above is None else self.above
        found = (mutation.file, mutation.source_line, mutation.change, mutation.above)
        return (self.file, self.line, self.change, here) == found


def read_list(path: Path = LIST) -> list[Explained]:
    """Return all entries; raises TypeError for one that lacks a key."""
    entries = tomllib.loads(path.read_text(encoding="utf-8")).get("equivalent", [])
    return [
        Explained(entry["file"], entry["line"], change, entry["reason"], entry.get("above"))
        for entry in entries
        for change in ([entry["change"]] if isinstance(entry["change"], str) else entry["change"])
    ]


def reason(mutation: Mutation, entries: list[Explained]) -> str | None:
    """Return why MUTATION cannot be killed; None when nothing explains it."""
    return next((entry.reason for entry in entries if entry.matches(mutation)), None)
