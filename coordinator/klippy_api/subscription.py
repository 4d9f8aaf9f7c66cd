"""What a client watches, and what of it has changed since it was sent last; no I/O."""

from collections.abc import Collection, Mapping
from typing import Any, Final

from coordinator.klippy_api.params import RequestedFields

Status = Mapping[str, Mapping[str, Any]]
"""Objects by name, each with its fields."""
_NOTHING: Final[Mapping[str, Any]] = {}


class Subscription:
    """Fields of objects. Those that are wanted with null are all that the object has at the first look."""

    def __init__(self, template: Mapping[str, Any], requested: RequestedFields) -> None:
        self.template = template
        self.requested: dict[str, frozenset[str] | None] = {
            name: None if wanted is None else frozenset(wanted) for name, wanted in requested.items()
        }
        self._sent: dict[str, dict[str, Any]] = {}

    def begin(self, status: Status) -> Status:
        """Return all that is wanted of STATUS, and remember it as sent."""
        shown = select_fields(self.requested, status)
        for name, fields in shown.items():
            if self.requested[name] is None and fields:
                self.requested[name] = frozenset(fields)
            there = status.get(name, _NOTHING)
            self._sent[name] = {field: value for field, value in fields.items() if field in there}
        return shown

    def changes(self, status: Status) -> Status:
        """Return the fields that are not as they were sent last, and remember them as sent.

        It costs what STATUS has, however many objects and fields are wanted that there are not.
        """
        changed: dict[str, dict[str, Any]] = {}
        for name, fields in status.items():
            if name not in self.requested:
                continue
            wanted, sent = self.requested[name], self._sent.setdefault(name, {})
            for field, value in fields.items():
                if wanted is not None and field not in wanted:
                    continue
                # Static parts are the same objects in each status.
                if field in sent and (sent[field] is value or sent[field] == value):
                    continue
                sent[field] = value
                changed.setdefault(name, {})[field] = value
            for field in sent.keys() - fields.keys():  # it is gone
                del sent[field]
                changed.setdefault(name, {})[field] = None
        return changed


def select_fields(
    requested: Mapping[str, Collection[str] | None], status: Status
) -> dict[str, dict[str, Any]]:
    """Return what is wanted of STATUS: unknown objects are empty, unknown fields None."""
    shown: dict[str, dict[str, Any]] = {}
    for name, wanted in requested.items():
        fields = status.get(name)
        if fields is None:
            shown[name] = {}
        else:
            shown[name] = dict(fields) if wanted is None else {field: fields.get(field) for field in wanted}
    return shown
