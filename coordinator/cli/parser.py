"""The command-line parser: all commands with their options, and the job that a command line asks for."""

import argparse
from collections.abc import Callable, Sequence
from typing import Final, cast

from canbus_tools.bus.computer import Computer, ThisComputer
from canbus_tools.tools import parser as can_tools
from coordinator.cli.commands import (
    completion,
    config,
    demo,
    discover,
    dnc,
    plan,
    remote,
    run,
    simulate,
    table,
)
from coordinator.dnc.commands import HERE, Surroundings
from coordinator.support.report import Report
from coordinator.support.version import version
from nodes.support.option_values import Parser, UsageError

Job = Callable[[], Report]
COMMANDS: Final = (demo, run, plan, simulate, config, remote, discover, table, dnc, can_tools, completion)
"""Modules whose ``add_to(commands)`` adds one or more commands."""


def build_parser() -> Parser:
    """Return the parser with every command."""
    parser = Parser(
        prog="canductor",
        description="One coordinator conducts many micro-controllers on CAN buses and UARTs as one machine.",
    )
    parser.add_argument(
        "--version", action="version", version=f"canductor {version()}", help="print the version"
    )
    commands = parser.add_subparsers(title="commands", metavar="COMMAND", required=True)
    for module in COMMANDS:
        module.add_to(commands)
    return parser


def parse_command_line(
    words: Sequence[str], computer: Computer | None = None, surroundings: Surroundings = HERE
) -> Job:
    """Return the job that WORDS ask for. Tests give another COMPUTER to CAN tools, SURROUNDINGS to DNC.

    Raises UsageError, ParserExit after --help or --version, CanductorError for a file that cannot be read.
    """
    parser = build_parser()
    environment = argparse.Namespace(
        parser=parser, computer=computer or ThisComputer(), surroundings=surroundings
    )
    given, unknown = parser.parse_known_args(list(words), environment)

    def job() -> Report:
        try:
            if unknown:
                parser.error(f"unrecognized arguments: {' '.join(unknown)}")
            return cast("Report", given.run(given))
        except UsageError as error:
            error.command = given.command
            raise

    return job
