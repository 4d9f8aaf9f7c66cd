"""The words of ``canductor table``."""

import argparse
import importlib
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final, cast

from coordinator.cli.arguments.table_device import declare_device, device_job
from coordinator.support.command_options import Report
from nodes.support.option_values import UsageError, existing_file

_UNITS: Final = ("mm", "um", "nm", "inch", "deg", "arcmin", "arcsec")
SUMMARIES: Final = {
    "check": "read a table and tell what it holds, without a machine",
    "plot": "draw a table as an SVG picture",
    "send": "give a table to an axis of a machine that runs, or to drives at a device",
    "status": "tell which axes have tables, and what each node keeps",
    "remove": "take the table of an axis away, or those of drives at a device",
}


def declare_table(
    command: argparse.ArgumentParser,
    add_target: Callable[[argparse.ArgumentParser], None],
    target: Callable[[argparse.Namespace], Any],
) -> None:
    """Add the subcommands; ADD_TARGET and TARGET are the options that say which machine is meant."""
    actions = command.add_subparsers(title="actions", metavar="ACTION")
    for name, summary in SUMMARIES.items():
        action = actions.add_parser(name, help=summary, description=f"{summary}.", allow_abbrev=False)
        add = action.add_argument
        if name in ("check", "plot", "send"):
            add("file", type=Path, help="LinuxCNC COMP_FILE, or CSV (.csv) with units in its first line")
            add("--type", default="0", choices=("0", "1"), help="of a COMP_FILE: 0 actual positions, 1 trims")
            add("--unit", default="mm", choices=_UNITS, help="of all numbers of a COMP_FILE; mm if not given")
        if name in ("check", "plot"):
            add("--axis", type=str.lower, default="x", help="which axis it is for; x if not given")
        else:
            add("--axis", type=str.lower, help="which axis of the machine; of status: all if not given")
            add_target(action)
            declare_device(action, sends=name != "status", has_file=name == "send")
        if name == "check":
            add("--machine", type=Path, metavar="CONFIG", help="compare with the axis's travel there")
        if name == "plot":
            add("-o", "--output", type=Path, required=True, metavar="SVG", help="file to be written")
        add("--json", action="store_true", help="print one JSON object as the last line")
        action.set_defaults(make_job=lambda given, name=name: _job(name, given, target))
    command.set_defaults(make_job=_nothing)


def _nothing(_: argparse.Namespace) -> Callable[[], Report]:
    raise UsageError(f"the action is missing: {', '.join(SUMMARIES)}")


def _job(
    name: str, given: argparse.Namespace, target: Callable[[argparse.Namespace], Any]
) -> Callable[[], Report]:
    if name in ("check", "plot", "send"):
        existing_file(given.file)
    if name not in ("check", "plot") and given.device is not None:
        return _device_job(name, given)
    where = None if name in ("check", "plot") else target(given)
    if name in ("send", "remove"):
        _check_axis(name, given)
    if name == "check":
        existing_file(given.machine)
    if name == "plot" and given.output.suffix.lower() != ".svg":
        raise UsageError(f"--output is '{given.output}', must be a file that ends in .svg")

    def run() -> Report:
        module = importlib.import_module("coordinator.cli.commands.table")
        return cast("Report", getattr(module, name)(given, where))

    return run


def _check_axis(name: str, given: argparse.Namespace) -> None:
    for option in ("axles", "stepper", "node", "link", "delay"):
        if getattr(given, option):
            raise UsageError(f"--{option} goes with --device: what drives or nodes the table is for")
    if given.axis is None:
        raise UsageError(f"what '{name}' is for is missing: --axis of a machine that runs, or --device")


def _device_job(name: str, given: argparse.Namespace) -> Callable[[], Report]:
    if given.at is not None:
        raise UsageError(
            "--at is a machine that runs, --device what is reached without one; give one of them"
        )
    table = None
    if name == "send":
        module = importlib.import_module("coordinator.tables.files")
        table = module.read_table(
            given.file, axis=given.axis or "x", comp_type=int(given.type), unit=given.unit
        )
    job = device_job(given, table, sends=name != "status")
    return lambda: cast("Report", given.on_device(job))
