"""The commands ``canductor can TOOL`` and ``canductor console``: the list of tools.

A tool is a module with ``declare(command)``, which adds its options, and ``make_job(given)``, which checks
them and returns the job: a callable that takes the computer (bus/computer.py) and returns a report with
``ok``, ``to_json()`` and ``to_text()``.
"""

import argparse
from collections.abc import Callable, Mapping
from typing import Any, Final, Protocol

from canbus_tools.bus.computer import Computer
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
from nodes.support.option_values import add_command, add_group


class Tool(Protocol):
    """The module of a tool."""

    def declare(self, command: argparse.ArgumentParser, /) -> None:
        """Add the options of the tool."""

    def make_job(self, given: argparse.Namespace, /) -> Callable[[Computer], Any]:
        """Return the job; raises UsageError, CanductorError."""


TOOLS: Final[Mapping[str, tuple[Tool, str]]] = {
    "query": (query, "find the nodes that wait for an id"),
    "nodes": (nodes, "list all nodes that respond, and what they are"),
    "assign": (assign_id, "assign an id to a node"),
    "release": (release_id, "release the id of a node, so that it waits for one again"),
    "monitor": (monitor, "show live traffic, decoded, with statistics of every node"),
    "decode": (decode, "show a recording, decoded"),
    "record": (record, "record a bus to an MCAP file or a candump log"),
    "load": (load, "measure the load of a bus, and what causes it"),
    "doctor": (doctor, "check a bus, and explain what is wrong and what to do"),
    "inject": (inject, "run a virtual bus with faults, also for other CAN programs"),
    "dissector": (dissector, "write a Wireshark dissector of the protocol"),
}
"""Of ``canductor can``, by name: its module, and what it does."""


def add_to(commands: Any) -> None:
    """Add ``can`` with all tools, and ``console``; they run on ``given.computer`` where tests give one."""
    tools = add_group(commands, "can", "find, watch and debug nodes on a CAN bus", "TOOL")
    for name, (module, summary) in TOOLS.items():
        _add(tools, name, module, summary)
    _add(commands, "console", console, "send commands to one node and show its messages")


def _add(commands: Any, name: str, tool: Tool, summary: str) -> None:
    def run(given: argparse.Namespace) -> Any:
        return tool.make_job(given)(getattr(given, "computer", None) or Computer())

    add_command(commands, name, summary, tool.declare, run)
