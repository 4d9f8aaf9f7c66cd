"""What every command of the command line returns."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Protocol


class Report(Protocol):
    """The result of a command: printed as text, or as one JSON object on the last line."""

    @property
    def ok(self) -> bool:
        """Whether the command succeeded; decides the exit status."""

    def to_json(self) -> Mapping[str, object]:
        """Return the result as JSON values by name; the command line adds "ok"."""

    def to_text(self) -> str:
        """Return the result for a reader; if not ok, with what failed and what to do."""


@dataclass(frozen=True, slots=True)
class PlainReport:
    """A report whose values and text are known when it is made."""

    values: Mapping[str, object]
    text: str
    ok: bool = True

    def to_json(self) -> Mapping[str, object]:
        """Return the values."""
        return self.values

    def to_text(self) -> str:
        """Return the text."""
        return self.text
