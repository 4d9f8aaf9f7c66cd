"""``canductor config``: check a configuration without hardware, or print what one may contain."""

import argparse
import importlib
from pathlib import Path
from typing import cast

from coordinator.support.command_options import Report
from nodes.support.option_values import existing_file


def declare(command: argparse.ArgumentParser) -> None:
    """Add what can be done."""
    doings = command.add_subparsers(title="what to do", metavar="WHAT")
    check = doings.add_parser("check", help="list everything that is wrong with a file", allow_abbrev=False)
    check.add_argument("file", type=Path, help="configuration file")
    reference = doings.add_parser("reference", help="print all sections and options", allow_abbrev=False)
    reference.add_argument("section", nargs="*", help="only sections whose name begins so")
    for doing, make_job in ((check, _check), (reference, _reference)):
        doing.add_argument("--json", action="store_true", help="print one JSON object as the last line")
        doing.set_defaults(make_job=make_job)


def _check(given: argparse.Namespace) -> "object":
    existing_file(given.file)
    return lambda: _run("check", str(given.file))


def _reference(given: argparse.Namespace) -> "object":
    return lambda: _run("reference", tuple(given.section))


def _run(name: str, *arguments: object) -> Report:
    function = getattr(importlib.import_module("coordinator.cli.commands.config"), name)
    return cast("Report", function(*arguments))
