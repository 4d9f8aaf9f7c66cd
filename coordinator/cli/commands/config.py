"""``canductor config``: checks a configuration without hardware, or prints what one may contain."""

import argparse
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from coordinator.assembly import reference as tables
from coordinator.assembly.check import check_config
from coordinator.assembly.consequences import meaning
from coordinator.assembly.load import load_machine
from coordinator.config.errors import ConfigError
from coordinator.config.model import Unsupported
from coordinator.support.report import PlainReport, Report
from nodes.support.errors import CanductorError
from nodes.support.option_values import add_command, add_group, existing_file


def add_to(commands: Any) -> None:
    """Add the commands."""
    summary = "check a configuration, or print the sections and options that one may contain"
    actions = add_group(commands, "config", summary, "ACTION")
    add_command(actions, "check", "list every mistake in a configuration file", _declare_check, _check)
    add_command(actions, "reference", "print all sections and options", _declare_reference, _reference)


def _declare_check(command: argparse.ArgumentParser) -> None:
    command.add_argument("file", type=existing_file, help="configuration file")


def _check(given: argparse.Namespace) -> Report:
    return check(str(given.file))


def _declare_reference(command: argparse.ArgumentParser) -> None:
    command.add_argument("section", nargs="*", help="print only sections whose names begin with this")


def _reference(given: argparse.Namespace) -> Report:
    return reference(given.section)


@dataclass(frozen=True, slots=True)
class CheckReport:
    """What is wrong with a configuration."""

    path: str
    problems: Sequence[CanductorError]
    notices: Sequence[str]
    """What is worth knowing, when nothing is wrong."""
    unsupported: Sequence[Unsupported] = ()
    """What is right but does not act, when nothing is wrong."""

    @property
    def ok(self) -> bool:
        """Whether the machine can be brought up with it, as far as is known without the machine."""
        return not self.problems

    def to_json(self) -> Mapping[str, Any]:
        """Return it for --json."""
        return {
            "problems": [
                {"file": place.path, "line": place.line, "sentence": str(problem)}
                if (place := problem.place if isinstance(problem, ConfigError) else None) is not None
                else {"file": self.path, "line": 0, "sentence": str(problem)}
                for problem in self.problems
            ],
            "notices": list(self.notices),
            "unsupported": [
                {
                    "section": entry.section,
                    "options": list(entry.options),
                    "file": entry.place.path,
                    "line": entry.place.line,
                    "reason": entry.reason,
                    "meaning": meaning(entry),
                }
                for entry in self.unsupported
            ],
        }

    def to_text(self) -> str:
        """Return a line for each."""
        count = len(self.problems)
        end = f"{self.path}: {count or 'no'} mistake{'' if count == 1 else 's'}"
        return "\n".join([*map(str, self.problems), *self.notices, end, *self._not_acting_lines()])

    def _not_acting_lines(self) -> list[str]:
        """Return the list of what will not act, and what that means for a print."""
        if not self.unsupported:
            return []
        return [
            "",
            "What will not act, and what that means for a print:",
            *(f"  {entry}: {meaning(entry)}" for entry in self.unsupported),
        ]


def check(path: str) -> CheckReport:
    """Find everything that is wrong with the configuration PATH."""
    problems = check_config(path)
    if problems:
        return CheckReport(path, problems, ())
    described = load_machine(path)
    return CheckReport(path, problems, described.notes, described.unsupported)


def reference(beginnings: Sequence[str]) -> Report:
    """Return the tables of all sections, or of those whose name begins with one of BEGINNINGS."""
    wanted = [word.strip("[]") for word in beginnings]
    titles = [
        title
        for title in tables.sections()
        if not wanted or any(title.lstrip("[").startswith(word) for word in wanted)
    ]
    if not titles:
        raise CanductorError(
            f"no section begins with {' or '.join(wanted)}; 'canductor config reference' prints all"
        )
    text = "\n".join(map(tables.section_table, titles)).rstrip()
    return PlainReport({"sections": {title: tables.section_json(title) for title in titles}}, text)
