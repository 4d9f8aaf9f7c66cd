"""``canductor demo``: a machine on virtual nodes, printing or served to front ends."""

import argparse
from functools import partial
from pathlib import Path
from typing import Any

from coordinator.cli.arguments.serving import declare_serving, refuse_serving_options, serving_options
from coordinator.demo.run import DemoOptions, run_demo
from coordinator.demo.serve import serve_demo
from coordinator.support.examples import DEMO_GCODE, DEMO_MACHINE, find_machine
from coordinator.support.report import Report
from nodes.support.numbers import read_decimal, read_int
from nodes.support.option_values import (
    Assignments,
    UsageError,
    add_command,
    existing_file,
    options_from,
    parse_assignment,
    parse_int,
    parse_ratio,
)


def add_to(commands: Any) -> None:
    """Add the command."""
    summary = "print on virtual nodes and compare every step with the plan"
    add_command(commands, "demo", summary, _declare, _run)


def _declare(command: argparse.ArgumentParser) -> None:
    add = command.add_argument
    add(
        "--machine",
        type=find_machine,
        default=DEMO_MACHINE,
        help="configuration file or example; its nodes are replaced by virtual ones (default: demo)",
    )
    add(
        "--gcode",
        type=existing_file,
        metavar="FILE",
        help="G-code file to print (default: the part of the demo)",
    )
    add("--no-web", action="store_true", help="refuse --web; for scripts")
    add(
        "--loss",
        type=parse_ratio,
        default=0.0,
        metavar="RATIO",
        help="ratio of frames that the virtual buses lose, such as 0.01 or 1%%",
    )
    add("--seed", type=parse_int, default=1, metavar="N", help="selects the frames to lose (default: 1)")
    add(
        "--rate-ppm",
        type=partial(parse_assignment, convert=_ppm),
        action=Assignments,
        metavar="NODE=X",
        help="deviation of a node's clock from its nominal frequency, in ppm",
    )
    add(
        "--start-clock",
        type=partial(parse_assignment, convert=_ticks),
        action=Assignments,
        metavar="NODE=N",
        help="initial value of a node's clock, in ticks",
    )
    add("--keep", type=Path, metavar="DIR", help="keep the step logs in this folder")
    add(
        "--cold", action="store_true", help="start with cold heaters, which take as long as real ones to heat"
    )
    add("--serve", action="store_true", help="serve the virtual machine to front ends instead of printing")
    add(
        "--socketcan",
        type=_bus_interface,
        action=Assignments,
        everything="all buses",
        metavar="[BUS=]INTERFACE",
        help="use this SocketCAN interface, such as vcan0, for the machine's CAN bus BUS (default: for all)",
    )
    declare_serving(command)


def _run(given: argparse.Namespace) -> Report:
    if given.serve and given.gcode is not None:
        raise UsageError("--serve does not print by itself; leave out --gcode or --serve")
    if given.web is not None and given.no_web:
        raise UsageError("--web and --no-web exclude each other; leave one out")
    if not given.serve:
        refuse_serving_options(given, "give --serve")
    if given.socketcan and given.loss:
        raise UsageError(
            "--loss is for virtual buses; to lose frames of an interface, use 'tc qdisc add dev INTERFACE"
            " root netem loss 1%' (docs/can/vcan.md)"
        )
    options = options_from(DemoOptions, given, gcode=given.gcode or DEMO_GCODE)
    if given.serve:
        return serve_demo(options, serving_options(given, given.machine, announce=False))
    return run_demo(options)


def _bus_interface(text: str) -> tuple[str, str]:
    return parse_assignment(text, str) if "=" in text else ("", text)


def _ppm(text: str) -> float:
    value = read_decimal(text)
    if value is None or not -10_000 <= value <= 10_000:
        raise ValueError("a number in ppm, from -10000 to 10000")
    return value


def _ticks(text: str) -> int:
    ticks = read_int(text)
    if ticks is None or not 0 <= ticks < 2**64:
        raise ValueError("a whole number of ticks, from 0 to 2^64 - 1")
    return ticks
