"""Updates of the state tree as messages, encoded once for all watchers that are at the same point."""

from typing import Final

from coordinator.ipc.protocol.messages import Encoder, Encoding
from coordinator.ipc.server.state import FieldFilter, StateTree
from coordinator.support.values import Value

FILTERS_MAX: Final = 256
"""Different filters that are kept, for watchers of the same fields."""
UPDATE_ENTRIES: Final = 8
"""Of the message "state": event, subscription, since, sequence, skipped, snapshot, values, removed."""


class Publisher:
    """Writes updates of STATE; lives on one loop."""

    def __init__(self, state: StateTree, encoder: Encoder) -> None:
        self.state = state
        self.encoder = encoder
        self.unsendable = 0
        """Values left out of updates because no message can carry them."""
        self._filters: dict[tuple[str, ...], FieldFilter] = {}
        self._bodies: dict[tuple[FieldFilter, int, Encoding], bytes | None] = {}
        self._bodies_of = -1  # the sequence number that _bodies lead to

    def filter(self, globs: list[str]) -> FieldFilter:
        """Return the filter of GLOBS, the same for all who want the same."""
        wanted = tuple(sorted(set(globs)))
        kept = self._filters.get(wanted)
        if kept is None:
            kept = self._filters[wanted] = FieldFilter(wanted)
        while len(self._filters) > FILTERS_MAX:
            del self._filters[next(iter(self._filters))]
        return kept

    def body(self, wanted: FieldFilter, since: int, encoding: Encoding) -> bytes | None:
        """Return the last three entries of an update, None when nothing WANTED changed after SINCE."""
        self.state.bring_up_to_date()
        if self.state.sequence != self._bodies_of:
            self._bodies.clear()
            self._bodies_of = self.state.sequence
        key = (wanted, since, encoding)
        if key not in self._bodies:
            self._bodies[key] = self._make_body(wanted, since, encoding)
        return self._bodies[key]

    def _make_body(self, wanted: FieldFilter, since: int, encoding: Encoding) -> bytes | None:
        changes = self.state.changes_since(since, wanted)
        if not changes.values and not changes.removed and not changes.snapshot:
            return None
        values: dict[str, Value] = changes.values
        removed: list[Value] = list(changes.removed)
        try:
            return self._entries(encoding, values, removed, changes.snapshot)
        except ValueError:  # one value that no message can carry must not hide all others
            sound = {path: value for path, value in values.items() if self._can_be_sent(value)}
            self.unsendable += len(values) - len(sound)
            return self._entries(encoding, sound, removed, changes.snapshot)

    def _entries(
        self, encoding: Encoding, values: dict[str, Value], removed: list[Value], snapshot: bool
    ) -> bytes:
        return self.encoder.entries(encoding, {"snapshot": snapshot, "values": values, "removed": removed})

    def _can_be_sent(self, value: Value) -> bool:
        try:
            for encoding in Encoding:
                self.encoder.entries(encoding, {"": value})
        except ValueError:
            return False
        return True


class Subscription:
    """What one watcher has received, and when the next update is due; times in s of one clock."""

    def __init__(
        self, number: int, wanted: FieldFilter, period_s: float, phase: float, sequence: int
    ) -> None:
        self.number = number
        self.skipped = 0
        """Updates since the last one that were due and merged, as the watcher did not read."""
        self.next_s = 0.0
        self._wanted = wanted
        self._period_s = period_s
        self._phase = phase
        self._seen = self._sent = sequence

    def schedule(self, now_s: float) -> None:
        """Put the next update to the next multiple of the period, so that watchers of one rate share it."""
        self.next_s = (now_s / self._period_s // 1 + 1 + self._phase) * self._period_s

    def update(self, publisher: Publisher, encoding: Encoding) -> bytes | None:
        """Return the next message, None when nothing changed."""
        body = publisher.body(self._wanted, self._seen, encoding)
        self._seen = sequence = publisher.state.sequence
        if body is None:
            return None
        head = publisher.encoder.entries(
            encoding,
            {
                "event": "state",
                "subscription": self.number,
                "since": self._sent,
                "sequence": sequence,
                "skipped": self.skipped,
            },
        )
        self._sent, self.skipped = sequence, 0
        return publisher.encoder.joined(encoding, UPDATE_ENTRIES, head, body)
