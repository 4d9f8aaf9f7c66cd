"""The command line as tests use it."""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import pytest

from canbus_tools.bus.computer import Computer
from coordinator.cli.main import main
from coordinator.cli.parser import parse_command_line


@dataclass(frozen=True)
class Said:
    """What a tool printed, and its exit status."""

    status: int
    out: str
    err: str

    @property
    def json(self) -> dict[str, Any]:
        """The object on the last line."""
        value = json.loads(self.out.splitlines()[-1])
        assert isinstance(value, dict)
        return value

    @property
    def objects(self) -> list[dict[str, Any]]:
        """The objects of all lines."""
        return [json.loads(line) for line in self.out.splitlines()]

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
    """Runs ``canductor …`` on COMPUTER; WORDS name the bus, for ``canductor can TOOL`` and ``console``."""

    def __init__(
        self, computer: Computer | None, captured: pytest.CaptureFixture[str], words: Sequence[str] = ()
    ) -> None:
        self._computer = computer
        self._captured = captured
        self._words = words

    def __call__(self, tool: str, *words: object) -> Said:
        """Run ``canductor can TOOL`` on the bus."""
        return self.run("can", tool, *words, *self._words)

    def console(self, *words: object) -> Said:
        """Run ``canductor console`` on the bus."""
        return self.run("console", *words, *self._words)

    def run(self, *words: object) -> Said:
        """Run ``canductor WORDS``."""
        self._captured.readouterr()
        status = main(list(map(str, words)), partial(parse_command_line, computer=self._computer))
        said = self._captured.readouterr()
        return Said(status, said.out, said.err)
