"""The command line of ``canductor can`` and ``canductor console``: the tools and their options.

A tool is a module with ``declare(command)``, which adds its options, and ``make_job(given)``, which checks
the options and returns the job: a callable that takes the computer (bus/computer.py) and returns a report
with ``ok``, ``to_json()`` and ``to_text()``.
"""

import argparse
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any, Final, Protocol

from canbus_tools.bus.computer import Computer, ThisComputer
from canbus_tools.dissector import dissector
from canbus_tools.tools import (
    assign_id,
    console,
    decode,
    doctor,
    inject,
    load,
    monitor,
    nodes,
    query,
    record,
    release_id,
)


class Tool(Protocol):
    """The module of a tool."""

    def declare(self, command: argparse.ArgumentParser, /) -> None:
        """Add the options of the tool."""

    def make_job(self, given: argparse.Namespace, /) -> Callable[[Computer], Any]:
        """Return the job; raises UsageError, CanductorError."""


TOOLS: Final[Mapping[str, tuple[Tool, str]]] = {
    "query": (query, "find the nodes that wait for an id"),
    "nodes": (nodes, "list every node that is alive, and what it is"),
    "assign": (assign_id, "give a node its id"),
    "release": (release_id, "take a node's id back: it waits for one again"),
    "monitor": (monitor, "show live traffic, decoded, with figures of every node"),
    "decode": (decode, "show a recording, decoded"),
    "record": (record, "record a bus to MCAP or a candump log"),
    "load": (load, "measure how busy a bus is, and with what"),
    "doctor": (doctor, "check a bus, and explain what is wrong and what to do"),
    "inject": (inject, "run a virtual bus with faults, also for other CAN programs"),
    "dissector": (dissector, "write a Wireshark dissector of the protocol"),
}
"""Of ``canductor can``, by name: its module, and what it does."""
CONSOLE: Final[tuple[Tool, str]] = (console, "talk to one node in its own words")


def add_tools(can: argparse.ArgumentParser, computer: Computer | None = None) -> None:
    """Add all tools to the parser of ``canductor can``; they will run on COMPUTER, this one if None."""
    tools = can.add_subparsers(title="tools", metavar="TOOL")
    for name in TOOLS:
        declare_tool(tools, name, computer)


def declare_tool(tools: Any, name: str, computer: Computer | None = None) -> None:
    """Add the tool NAME, which will run on COMPUTER, with its options to the subparsers TOOLS."""
    module, summary = TOOLS.get(name, CONSOLE)
    command = tools.add_parser(name, help=summary, description=f"{summary}.", allow_abbrev=False)
    module.declare(command)
    command.add_argument("--json", action="store_true", help="print one JSON object as the last line")
    command.set_defaults(make_job=partial(_make_job, module.make_job, computer or ThisComputer()))


def _make_job(
    make: Callable[[argparse.Namespace], Callable[[Computer], Any]],
    computer: Computer,
    given: argparse.Namespace,
) -> Callable[[], Any]:
    return partial(make(given), computer)
