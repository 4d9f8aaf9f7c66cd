"""The words of ``canductor can``: which tools there are. Each tool declares its own options.

A tool is a module with ``declare(command)``, which adds its options, and ``make_job(given)``, which checks
what was given and returns the job: a callable that takes the computer (``computer.py``) and returns a report
with ``ok``, ``to_json()`` and ``to_text()``.
Only the module of the tool that is named gets imported.
"""

import argparse
import importlib
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, Final

from canbus_tools.bus.computer import Computer, ThisComputer

TOOLS: Final[dict[str, tuple[str, str]]] = {
    "query": ("query", "find the nodes that wait for an id"),
    "nodes": ("node_list", "list every node that is alive, and what it is"),
    "assign": ("assign_id", "give a node its id"),
    "release": ("release_id", "take a node's id back: it waits for one again"),
    "monitor": ("monitor", "show live traffic, decoded, with figures of every node"),
    "decode": ("decode", "show a recording, decoded"),
    "record": ("record", "record a bus to MCAP or a candump log"),
    "load": ("load", "measure how busy a bus is, and with what"),
    "doctor": ("doctor", "check a bus, and explain what is wrong and what to do"),
    "inject": ("inject", "run a virtual bus with faults, also for other CAN programs"),
    "dissector": ("dissector", "write a Wireshark dissector of the protocol"),
}
"""Of ``canductor can``, by name: the module in this package, and what it does."""
CONSOLE: Final = ("console", "talk to one node in its own words")


def add_tools(
    can: argparse.ArgumentParser,
    words: Sequence[str] = (),
    *,
    all_tools: bool = False,
    computer: Computer | None = None,
) -> None:
    """Add all tools to the parser of ``canductor can``; the one that WORDS name with its options, or ALL.

    They will run on COMPUTER, this one if None.
    """
    tools = can.add_subparsers(title="tools", metavar="TOOL")
    named = next((word for word in words[1:] if not word.startswith("-")), None)
    for name, summary in TOOLS.items():
        if all_tools or name == named:
            declare_tool(tools, name, computer)
        else:
            tools.add_parser(name, help=summary[1])


def declare_tool(tools: Any, name: str, computer: Computer | None = None) -> None:
    """Add the tool NAME, which will run on COMPUTER, with its options to the subparsers TOOLS."""
    module_name, summary = TOOLS.get(name, CONSOLE)
    module = importlib.import_module(f"canbus_tools.{module_name}")
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
