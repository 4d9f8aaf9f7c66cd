"""What the machine has said lately, for front ends that come later."""

from collections import deque
from collections.abc import Callable, Mapping
from datetime import UTC, datetime
from typing import Final

from coordinator.gcode.reply_kinds import ReplyKind
from nodes.support.terminal import printable_lines

KEEP: Final = 1000
TEXT_MAX: Final = 2000

Entry = Mapping[str, str | int]


class LogRing:
    """The last KEEP lines, numbered from 1; ON_LINE gets every new one."""

    def __init__(self, on_line: Callable[[Entry], None]) -> None:
        self._lines: deque[Entry] = deque(maxlen=KEEP)
        self._on_line = on_line
        self.count = 0
        """Lines so far: the number of the newest."""

    def add(self, kind: str, text: str, output: ReplyKind | None = None) -> None:
        """Add a line of KIND: state, notice, reply or stop; OUTPUT: it answers g-code, and how it reads."""
        self.count += 1
        at = datetime.now(UTC).isoformat(timespec="milliseconds")
        entry: Entry = {
            "number": self.count,
            "time": at,
            "kind": kind,
            "text": printable_lines(text[:TEXT_MAX]),
        }
        if output is not None:
            entry = {**entry, "output": str(output)}
        self._lines.append(entry)
        self._on_line(entry)

    def tail(self, count: int, after: int = 0) -> list[Entry]:
        """Return at most the newest COUNT lines numbered above AFTER, oldest first."""
        found = [entry for entry in self._lines if int(entry["number"]) > after]
        return found[-count:] if count else []
