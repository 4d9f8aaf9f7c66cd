"""``canductor discover``: lists the machines that can be reached."""

import argparse
from typing import Any

from coordinator.ipc.discovery.find import find_machines
from coordinator.support.interrupts import run_to_end
from coordinator.support.report import Report
from nodes.support.option_values import add_command, decimal


def add_to(commands: Any) -> None:
    """Add the command."""
    summary = "list the machines that run on this computer or are announced on the network"
    add_command(commands, "discover", summary, _declare, _run)


def _declare(command: argparse.ArgumentParser) -> None:
    command.add_argument(
        "--timeout",
        type=decimal(0.1, 60, "s"),
        default=3.0,
        metavar="S",
        help="how long to wait for answers, in seconds",
    )


def _run(given: argparse.Namespace) -> Report:
    return run_to_end(lambda: find_machines(given.timeout))
