"""What front ends see of the machine: fields by path, each with the sequence number of its last change.

Every change gets the next sequence number. A watcher that has seen everything up to one number asks for what
changed since: only the newest value of each field, however long it was away. So a slow watcher costs nothing:
there is no queue for it, only the tree itself, one value and one number per field.

Reading calls ``bring_up_to_date`` first, so that nobody has to fill a tree that is not looked at.
"""

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Final

from coordinator.support.values import Value

FIELDS_MAX: Final = 16_384
"""Fields in a tree; further ones are refused and counted."""
REMOVALS_MAX: Final = 1_024
"""Removed paths that are remembered; who was away for longer gets a snapshot."""
MATCHES_MAX: Final = 2 * FIELDS_MAX
"""Answers that a filter remembers."""


class FieldFilter:
    """Paths that match one of GLOBS: ``*`` stands for any characters, dots included.

    No regular expressions: strangers choose the globs, and compiling some would keep the loop for 0.1 s.
    """

    def __init__(self, globs: Iterable[str] = ("*",)) -> None:
        self.globs = tuple(sorted(set(globs)))
        self._whole = frozenset(glob for glob in self.globs if "*" not in glob)
        self._begins = tuple(glob[:-1] for glob in self.globs if glob.find("*") == len(glob) - 1 >= 0)
        self._others = tuple(tuple(glob.split("*")) for glob in self.globs if "*" in glob[:-1])
        self._known: dict[str, bool] = {}

    def matches(self, path: str) -> bool:
        """Return whether PATH matches."""
        if path in self._whole or path.startswith(self._begins):
            return True
        if not self._others:
            return False
        found = self._known.get(path)
        if found is None:
            if len(self._known) >= MATCHES_MAX:
                self._known.clear()
            found = self._known[path] = _matches_any(self._others, path)
        return found


def costly_stars(globs: Iterable[str]) -> int:
    """Return how often GLOBS make a search necessary: by each ``*`` that is not their last character."""
    return sum(glob[:-1].count("*") for glob in globs)


def _matches_any(globs: Iterable[tuple[str, ...]], path: str) -> bool:
    """Return whether PATH consists of the pieces of one of GLOBS with anything between them."""
    for pieces in globs:
        first, last = pieces[0], pieces[-1]
        if not path.endswith(last) or not path.startswith(first):
            continue
        at, end = len(first), len(path) - len(last)
        for piece in pieces[1:-1]:  # each as early as can be
            at = path.find(piece, at, end)
            if at < 0:
                break
            at += len(piece)
        else:
            if at <= end:
                return True
    return False


EVERYTHING: Final = FieldFilter()


@dataclass(frozen=True, slots=True)
class Changes:
    """What changed from just after SINCE up to and including SEQUENCE.

    SNAPSHOT: values are all there is, whatever was known before is void (and SINCE is 0).
    """

    since: int
    sequence: int
    values: dict[str, Value]
    removed: tuple[str, ...] = ()
    snapshot: bool = False


class StateTree:
    """The fields of one machine; lives on one loop. Lists and maps that it is given must not be changed."""

    def __init__(self) -> None:
        self.sequence = 0
        self.refused = 0
        """Changes refused because the tree is full."""
        self.bring_up_to_date: Callable[[], None] = lambda: None
        """Puts in what was not put in all along; set by the owner of the values."""
        self._fields: dict[str, tuple[Value, int]] = {}  # in the order of their last change
        self._removed: dict[str, int] = {}  # likewise
        self._forgotten = 0  # the newest removal that is not remembered any more

    def __len__(self) -> int:
        return len(self._fields)

    def get(self, path: str) -> Value:
        """Return the value at PATH; None where there is none."""
        self.bring_up_to_date()
        return self.latest(path)

    def latest(self, path: str) -> Value:
        """Return the value at PATH that was put in last; for who puts values in."""
        return self._fields.get(path, (None, 0))[0]

    def set(self, path: str, value: Value) -> None:
        """Put VALUE at PATH; without effect when it is there. A number that is not finite becomes None."""
        if type(value) is float and not math.isfinite(value):
            value = None
        before = self._fields.get(path)
        if before is not None:
            if type(before[0]) is type(value) and before[0] == value:
                return
            del self._fields[path]  # so that it goes to the end
        elif len(self._fields) >= FIELDS_MAX:
            self.refused += 1
            return
        else:
            self._removed.pop(path, None)
        self.sequence += 1
        self._fields[path] = (value, self.sequence)

    def update(self, prefix: str, values: Mapping[str, Value]) -> None:
        """Put each of VALUES at PREFIX.name."""
        for name, value in values.items():
            self.set(f"{prefix}.{name}", value)

    def remove(self, prefix: str) -> None:
        """Remove the field PREFIX and all fields below it."""
        below = f"{prefix}."
        for path in [p for p in self._fields if p == prefix or p.startswith(below)]:
            del self._fields[path]
            self.sequence += 1
            self._removed[path] = self.sequence
        while len(self._removed) > REMOVALS_MAX:
            self._forgotten = self._removed.pop(next(iter(self._removed)))

    def snapshot(self, wanted: FieldFilter = EVERYTHING) -> Changes:
        """Return all fields that are WANTED."""
        self.bring_up_to_date()
        values = {path: value for path, (value, _) in self._fields.items() if wanted.matches(path)}
        return Changes(0, self.sequence, values, snapshot=True)

    def changes_since(self, sequence: int, wanted: FieldFilter = EVERYTHING) -> Changes:
        """Return what changed after SEQUENCE; a snapshot where that is not known any more, or never was."""
        if not self._forgotten <= sequence <= self.sequence:
            return self.snapshot(wanted)
        values: dict[str, Value] = {}
        for path, (value, changed) in reversed(self._fields.items()):
            if changed <= sequence:
                break
            if wanted.matches(path):
                values[path] = value
        removed: list[str] = []
        for path, changed in reversed(self._removed.items()):
            if changed <= sequence:
                break
            if wanted.matches(path):
                removed.append(path)
        return Changes(sequence, self.sequence, values, tuple(removed))
