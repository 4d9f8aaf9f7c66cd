"""``canductor completion``: prints the script that makes a shell complete command lines of canductor."""

import argparse
from typing import Any, Final

import shtab

from coordinator.support.report import PlainReport, Report
from nodes.support.option_values import add_command

SHELLS: Final = ("bash", "zsh", "fish")


def add_to(commands: Any) -> None:
    """Add the command."""
    add_command(commands, "completion", "print a shell completion script", _declare, _run)


def _declare(command: argparse.ArgumentParser) -> None:
    command.add_argument("shell", choices=SHELLS, help="shell that the script is for")


def _run(given: argparse.Namespace) -> Report:
    script = shtab.complete(given.parser, given.shell)
    return PlainReport({"result": script}, script.rstrip())
