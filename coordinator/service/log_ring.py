"""What the machine has said lately, for front ends that come later."""

from collections import deque
from collections.abc import Callable, Mapping
from datetime import UTC, datetime
from typing import Final

KEEP: Final = 1000
TEXT_MAX: Final = 2000

Entry = Mapping[str, str | int]


class LogRing:
    """The last KEEP lines, numbered from 1; ON_LINE hears every new one."""

    def __init__(self, on_line: Callable[[Entry], None]) -> None:
        self._lines: deque[Entry] = deque(maxlen=KEEP)
        self._on_line = on_line
        self.count = 0
        """Lines so far: the number of the newest."""

    def add(self, kind: str, text: str) -> None:
        """Add a line of KIND: state, notice, reply or stop."""
        self.count += 1
        at = datetime.now(UTC).isoformat(timespec="milliseconds")
        entry: Entry = {"number": self.count, "time": at, "kind": kind, "text": text[:TEXT_MAX]}
        self._lines.append(entry)
        self._on_line(entry)

    def tail(self, count: int, after: int = 0) -> list[Entry]:
        """Return at most the newest COUNT lines numbered above AFTER, oldest first."""
        found = [entry for entry in self._lines if int(entry["number"]) > after]
        return found[-count:] if count else []
