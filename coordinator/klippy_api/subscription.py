"""What a client watches, and what of it has changed since it was sent last; no I/O."""

from collections.abc import Mapping
from typing import Any

from coordinator.klippy_api.params import RequestedFields

Status = Mapping[str, Mapping[str, Any]]
"""Objects by name, each with its fields."""


class Subscription:
    """Fields of objects. Those that are wanted with null are all that the object has at the first look."""

    def __init__(self, template: Mapping[str, Any], requested: RequestedFields) -> None:
        self.template = template
        self.requested: dict[str, list[str] | None] = dict(requested)
        self._sent: dict[str, dict[str, Any]] = {}

    def begin(self, status: Status) -> Status:
        """Return all that is wanted of STATUS, and remember it as sent."""
        shown = select_fields(self.requested, status)
        for name, fields in shown.items():
            if self.requested[name] is None and fields:
                self.requested[name] = list(fields)
        self._sent = {name: dict(fields) for name, fields in shown.items()}
        return shown

    def changes(self, status: Status) -> Status:
        """Return the fields that are not as they were sent last, and remember them as sent."""
        changed: dict[str, dict[str, Any]] = {}
        for name, wanted in self.requested.items():
            fields = status.get(name)
            if fields is None:
                continue
            sent = self._sent.setdefault(name, {})
            for field in fields if wanted is None else wanted:
                value = fields.get(field)
                # Static parts are the same objects in each status.
                if field in sent and (sent[field] is value or sent[field] == value):
                    continue
                sent[field] = value
                changed.setdefault(name, {})[field] = value
        return changed


def select_fields(requested: RequestedFields, status: Status) -> dict[str, dict[str, Any]]:
    """Return what is wanted of STATUS: unknown objects are empty, unknown fields None."""
    shown: dict[str, dict[str, Any]] = {}
    for name, wanted in requested.items():
        fields = status.get(name)
        if fields is None:
            shown[name] = {}
        else:
            shown[name] = dict(fields) if wanted is None else {field: fields.get(field) for field in wanted}
    return shown
