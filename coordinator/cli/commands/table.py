"""``canductor table``: compensation tables in files, on a running machine, or on devices without one."""

import argparse
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

from canbus_tools.bus.computer import Computer
from canbus_tools.tables.table_device import carry_out
from coordinator.assembly.load import load_machine
from coordinator.cli.arguments.target import declare_target, target_of
from coordinator.cli.commands.table_device import declare_device, device_job
from coordinator.ipc.client.target import Target
from coordinator.streaming.compensation import corrected_axes, why_not_corrected
from coordinator.support.report import PlainReport, Report
from coordinator.tables.axis_table import AxisTable, TableError, figures, notes
from coordinator.tables.files import read_table
from coordinator.tables.plot import draw
from nodes.support.option_values import UsageError, add_command, add_group, existing_file, parse_path

UNITS: Final = ("mm", "um", "nm", "inch", "deg", "arcmin", "arcsec")
DOWNLOAD_TIMEOUT_S: Final = 120.0
"""A long table on a busy serial line takes that long."""


def _table_report(table: AxisTable, remarks: Sequence[str], output: Path | None = None) -> PlainReport:
    """Return a report of TABLE with REMARKS; OUTPUT: the drawing that was written."""
    f = figures(table)
    unit = f["unit"]
    lines = [
        f"axis {f['axis']}: {f['points']} points from {f['first']:g} to {f['last']:g} {unit}",
        f"  corrections from {f['least_correction']:g} to {f['greatest_correction']:g} {unit}",
        f"  greatest slope {f['greatest_slope']:.3g}, backlash up to {f['greatest_backlash']:g} {unit}",
        f"  error between points up to {f['between_points']:.2g} {unit}",
        *(f"  note: {remark}" for remark in remarks),
    ]
    if output is None:
        return PlainReport({**f, "notes": list(remarks)}, "\n".join(lines))
    written = {**f, "notes": list(remarks), "output": str(output)}
    return PlainReport(written, "\n".join([*lines, f"  drawn in {output}"]))


def add_to(commands: Any) -> None:
    """Add the commands."""
    summary = "check compensation tables of axes, and send them to a machine or to drives"
    actions = add_group(commands, "table", summary, "ACTION")
    for name, text, declare, run in (
        ("check", "read a table and report its content, without a machine", _declare_check, _check),
        ("plot", "draw a table as an SVG file", _declare_plot, _plot),
        ("send", "send a table to an axis of a running machine, or to drives", _declare_send, _send),
        ("status", "list the axes with tables, and the tables that nodes keep", _declare_status, _status),
        (
            "remove",
            "remove the table of an axis of a running machine, or of drives",
            _declare_remove,
            _remove,
        ),
    ):
        add_command(actions, name, text, declare, run)


def _declare_file(command: argparse.ArgumentParser, axis: str | None) -> None:
    add = command.add_argument
    add("file", type=existing_file, help="LinuxCNC COMP_FILE, or CSV (.csv) with units in its first line")
    add(
        "--type", type=int, default=0, choices=(0, 1), help="type of a COMP_FILE: 0 actual positions, 1 trims"
    )
    add("--unit", default="mm", choices=UNITS, help="unit of all numbers of a COMP_FILE (default: mm)")
    default = "" if axis is None else f" (default: {axis})"
    add("--axis", type=str.lower, default=axis, help=f"axis that the table is for{default}")


def _declare_check(command: argparse.ArgumentParser) -> None:
    _declare_file(command, "x")
    command.add_argument(
        "--machine",
        type=existing_file,
        metavar="CONFIG",
        help="compare the table with the axis's travel in this configuration",
    )


def _declare_plot(command: argparse.ArgumentParser) -> None:
    _declare_file(command, "x")
    command.add_argument(
        "-o", "--output", type=_svg_file, required=True, metavar="SVG", help="file to be written"
    )


def _svg_file(text: str) -> Path:
    return parse_path(text, ".svg")


def _declare_send(command: argparse.ArgumentParser) -> None:
    _declare_file(command, None)
    declare_target(command)
    declare_device(command, sends=True, has_file=True)


def _declare_status(command: argparse.ArgumentParser) -> None:
    command.add_argument("--axis", type=str.lower, help="axis of the machine (default: all)")
    declare_target(command)
    declare_device(command, sends=False, has_file=False)


def _declare_remove(command: argparse.ArgumentParser) -> None:
    command.add_argument("--axis", type=str.lower, help="axis of the machine")
    declare_target(command)
    declare_device(command, sends=True, has_file=False)


def _check(given: argparse.Namespace) -> Report:
    table = _read(given)
    return _table_report(table, _notes(table, given.machine))


def _plot(given: argparse.Namespace) -> Report:
    table = _read(given)
    try:
        given.output.write_text(draw(table), encoding="utf-8")
    except OSError as error:
        raise TableError(f"{given.output} cannot be written: {error.strerror or error}") from None
    return _table_report(table, (), given.output)


def _send(given: argparse.Namespace) -> Report:
    """Send a table; not ok if a node did not take it."""
    if given.device is not None:
        return _on_device(given, _read(given), sends=True)
    _check_axis("send", given)
    table = _read(given)
    params: dict[str, Any] = {
        "axis": table.axis,
        "unit": str(table.unit),
        "positions": list(table.positions),
        "forward": list(table.forward),
        "reverse": list(table.reverse),
    }
    result = _patient_target(given).call("table.send", params)
    return _answer(result, [f"note: {note}" for note in result["notes"]], result["downloads"])


def _status(given: argparse.Namespace) -> Report:
    if given.device is not None:
        return _on_device(given, None, sends=False)
    result = target_of(given).call("table.status")
    if given.axis is not None:
        result = {"axes": [axis for axis in result["axes"] if axis["axis"] == given.axis]}
        if not result["axes"]:
            raise TableError(f"the machine has no tables for an axis {given.axis}")
    return _answer(result, [])


def _remove(given: argparse.Namespace) -> Report:
    """Remove a table; not ok if a node keeps it."""
    if given.device is not None:
        return _on_device(given, None, sends=True)
    _check_axis("remove", given)
    result = _patient_target(given).call("table.remove", {"axis": given.axis})
    return _answer(result, [], result["downloads"])


def _on_device(given: argparse.Namespace, table: AxisTable | None, *, sends: bool) -> Report:
    if given.address is not None:
        raise UsageError("--at selects a running machine, --device drives without one; give one of them")
    computer = getattr(given, "computer", None) or Computer()
    return carry_out(computer, device_job(given, table, sends=sends))


def _check_axis(name: str, given: argparse.Namespace) -> None:
    for option, value in (
        ("axles", given.axles),
        ("stepper", given.steppers),
        ("node", given.nodes),
        ("link", given.link),
        ("delay", given.delay_s),
    ):
        if value:
            raise UsageError(f"--{option} goes with --device: it selects drives or nodes")
    if given.axis is None:
        raise UsageError(f"'{name}' needs --axis of a running machine, or --device")


def _patient_target(given: argparse.Namespace) -> Target:
    target = target_of(given)
    return replace(target, timeout_s=max(target.timeout_s, DOWNLOAD_TIMEOUT_S))


def _read(given: argparse.Namespace) -> AxisTable:
    return read_table(given.file, axis=given.axis or "x", comp_type=given.type, unit=given.unit)


def _notes(table: AxisTable, config: Path | None) -> list[str]:
    if config is None:
        return []
    description = load_machine(str(config))
    rails = {rail.axis: rail for rail in description.rails}
    if corrected_axes(description) and table.axis not in rails:
        raise TableError(f"{config} has no axis {table.axis}; its axes are {', '.join(rails)}")
    if why := why_not_corrected(description, table):
        raise TableError(why)
    rail = rails[table.axis]
    lines = notes(table, rail.position_min, rail.position_max)
    if description.axis_tables is None:
        lines.append("the machine takes no tables: add [axis_tables] to its configuration")
    elif len(table.positions) > description.axis_tables.points:
        lines.append(f"the machine has room for {description.axis_tables.points} points: raise 'points'")
    return lines


def _answer(result: Any, lines: list[str], downloads: Sequence[Mapping[str, Any]] = ()) -> Report:
    """Return it as text too, and what DOWNLOADS cost; not ok when a node has a problem."""
    problems = 0
    for axis in result["axes"]:
        found = axis["table"]
        lines.append(
            f"axis {axis['axis']}: " + ("no table" if found is None else f"{found['points']} points")
        )
        for side in axis["nodes"]:
            problems += bool(side.get("problem"))
            lines.append(f"  {_side(side)}")
    for one in downloads:
        axles = ", ".join(map(str, one["axles"]))
        lines.append(f"  to {'axle' if len(one['axles']) == 1 else 'axles'} {axles}: {one['summary']}")
    if not result["axes"]:
        lines.append("no axis of this machine can have a table; add [axis_tables] to its configuration")
    return PlainReport({"result": result}, "\n".join(lines), ok=not problems)


def _side(side: dict[str, Any]) -> str:
    where = f"{side['stepper']} {side['direction']} on node {side['node']} (axle {side['axle']})"
    text = f"{where}: {side['status']}"
    if side["status"] == "ok" and not side["points"]:
        text = (
            f"{where}: no table" if side["active"] else f"{where}: no table; the one before is still in use"
        )
    elif "generation" in side:
        used = "in use" if side["active"] else "not in use yet"
        text += f", generation {side['generation']}, {side['points']} points, {used}"
    return f"{text}; {side['problem']}" if side.get("problem") else text
