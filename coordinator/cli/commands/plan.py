"""``canductor plan``: plans a program without hardware."""

import argparse
from functools import partial
from pathlib import Path
from typing import Any

from coordinator.planning.options import PlanOptions
from coordinator.planning.plan import plan_file
from coordinator.support.report import Report
from nodes.support.option_values import (
    Assignments,
    add_command,
    existing_file,
    integer,
    options_from,
    parse_assignment,
    parse_path,
)


def add_to(commands: Any) -> None:
    """Add the command."""
    summary = "plan a file without hardware: report time, steps, bus load and warnings"
    add_command(commands, "plan", summary, _declare, _run)


def _declare(command: argparse.ArgumentParser) -> None:
    add = command.add_argument
    add("config", type=existing_file, help="configuration file")
    add("gcode", type=_program, help="G-code file; - reads standard input")
    add(
        "-o",
        "--output",
        type=Path,
        metavar="DIR",
        help="write command streams, report and plot to this folder",
    )
    add("--plot", type=_svg_file, metavar="FILE.svg", help="draw velocity, flow and bus load over print time")
    add(
        "--dictionary",
        dest="dictionaries",
        type=partial(parse_assignment, convert=existing_file),
        action=Assignments,
        metavar="NODE=FILE",
        help="data dictionary of a node (JSON); by default, the one it had when it was last connected",
    )
    add(
        "--bitrate",
        dest="can_bitrate",
        type=integer(10_000, 8_000_000),
        default=1_000_000,
        metavar="BIT/S",
        help="bit rate of the CAN buses",
    )
    add(
        "--table",
        dest="tables",
        type=_axis_table,
        action=Assignments,
        metavar="AXIS=FILE",
        help="apply this compensation table to an axis",
    )


def _run(given: argparse.Namespace) -> Report:
    return plan_file(options_from(PlanOptions, given))


def _program(text: str) -> Path:
    return Path(text) if text == "-" else existing_file(text)


def _svg_file(text: str) -> Path:
    return parse_path(text, ".svg")


def _axis_table(text: str) -> tuple[str, Path]:
    axis, path = parse_assignment(text, existing_file)
    return axis.lower(), path
