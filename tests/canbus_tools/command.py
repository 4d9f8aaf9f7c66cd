"""The command line as tests use it."""

import json
from dataclasses import dataclass
from typing import Any

import pytest

from coordinator.cli import main
from tests.canbus_tools.stage import Place


@dataclass(frozen=True)
class Said:
    """What a tool printed, and its exit status."""

    status: int
    out: str
    err: str

    @property
    def json(self) -> dict[str, Any]:
        value = json.loads(self.out.splitlines()[-1])
        assert isinstance(value, dict)
        return value

    @property
    def words(self) -> str:
        """The text without line breaks."""
        return " ".join(self.out.split())

    @property
    def sentence(self) -> str:
        """The one sentence it failed with."""
        assert (self.status, self.out) == (1, ""), self
        assert self.err.count("\n") == 1
        return self.err


class Command:
    """Runs ``canductor can TOOL`` on a bus."""

    def __init__(self, place: Place, captured: pytest.CaptureFixture[str]) -> None:
        self._place = place
        self._captured = captured

    def __call__(self, *words: str) -> Said:
        self._captured.readouterr()
        status = main(["can", *words, *self._place.words])
        said = self._captured.readouterr()
        return Said(status, said.out, said.err)
