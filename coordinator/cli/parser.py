"""The command-line parser: all commands with their options, and the job that a command line asks for."""

import argparse
from collections.abc import Callable, Mapping, Sequence
from importlib import import_module
from typing import Any, Final, cast

from coordinator.support.report import Report
from coordinator.support.version import VERSION
from nodes.support.option_values import Parser, UsageError

Job = Callable[[], Report]
COMMANDS: Final[Mapping[str, str]] = {
    "demo": "coordinator.cli.commands.demo",
    "run": "coordinator.cli.commands.run",
    "plan": "coordinator.cli.commands.plan",
    "simulate": "coordinator.cli.commands.simulate",
    "config": "coordinator.cli.commands.config",
    **dict.fromkeys(("status", "watch", "call", "send", "page", "estop"), "coordinator.cli.commands.remote"),
    "discover": "coordinator.cli.commands.discover",
    "table": "coordinator.cli.commands.table",
    "dnc": "coordinator.cli.commands.dnc",
    **dict.fromkeys(("can", "console"), "canbus_tools.tools.parser"),
    "completion": "coordinator.cli.commands.completion",
}
"""By command: the module whose ``add_to(commands)`` adds it.

A command line imports only the module of its command: all of them take a second and a half of CPU time, which
an emergency stop must not wait for (docs/adr/0014-command-imports.md).
"""


def build_parser(command: str = "") -> Parser:
    """Return the parser with every command, or with those of the module of COMMAND alone."""
    parser = Parser(
        prog="canductor",
        description="One coordinator conducts many micro-controllers on CAN buses and UARTs as one machine.",
    )
    parser.add_argument(
        "--version", action="version", version=f"canductor {VERSION}", help="print the version"
    )
    commands = parser.add_subparsers(title="commands", metavar="COMMAND", required=True)
    modules = COMMANDS.values() if command == "" else (COMMANDS[command],)
    for module in dict.fromkeys(modules):
        import_module(module).add_to(commands)
    return parser


def parse_command_line(words: Sequence[str], **environment: Any) -> Job:
    """Return the job that WORDS ask for; tests put a computer or surroundings for it into ENVIRONMENT.

    Raises UsageError, ParserExit after --help or --version, CanductorError for a file that cannot be read.
    """
    command = words[0] if words and words[0] in COMMANDS and words[0] != "completion" else ""
    parser = build_parser(command)
    given, unknown = parser.parse_known_args(list(words), argparse.Namespace(parser=parser, **environment))

    def job() -> Report:
        try:
            if unknown:
                parser.error(f"unrecognized arguments: {' '.join(unknown)}")
            return cast("Report", given.run(given))
        except UsageError as error:
            error.command = given.command
            raise

    return job
