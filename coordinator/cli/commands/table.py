"""``canductor table``: what its actions do. On a machine that runs, through its interface."""

import argparse
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from coordinator.assembly.load import load_machine
from coordinator.cli.arguments.front_ends import Target
from coordinator.cli.commands.front_ends import Answer, call
from coordinator.streaming.compensation import corrected_axes, why_not_corrected
from coordinator.tables.axis_table import AxisTable, TableError, figures, notes
from coordinator.tables.files import read_table
from coordinator.tables.plot import draw

DOWNLOAD_TIMEOUT_S = 120.0
"""A long table on a busy serial line takes its time."""


@dataclass(frozen=True, slots=True)
class Checked:
    """A table that is sound."""

    figures: Mapping[str, float | int | str]
    notes: tuple[str, ...]
    output: Path | None = None

    @property
    def ok(self) -> bool:
        """It is, or it would not be here."""
        return True

    def to_json(self) -> Mapping[str, object]:
        """Return the figures by name."""
        written = {} if self.output is None else {"output": str(self.output)}
        return {**self.figures, "notes": list(self.notes), **written}

    def to_text(self) -> str:
        """Return them for a reader."""
        f, unit = self.figures, self.figures["unit"]
        lines = [
            f"axis {f['axis']}: {f['points']} points from {f['first']:g} to {f['last']:g} {unit}",
            f"  corrections from {f['least_correction']:g} to {f['greatest_correction']:g} {unit}",
            f"  greatest slope {f['greatest_slope']:.3g}, backlash up to {f['greatest_backlash']:g} {unit}",
            f"  between its points it may miss up to {f['between_points']:.2g} {unit}",
            *(f"  note: {note}" for note in self.notes),
        ]
        if self.output is not None:
            lines.append(f"  drawn in {self.output}")
        return "\n".join(lines)


def check(given: argparse.Namespace, _target: None) -> Checked:
    """Read a table; raises TableError."""
    table = _read(given)
    return Checked(figures(table), tuple(_notes(table, given.machine)))


def plot(given: argparse.Namespace, _target: None) -> Checked:
    """Draw a table; raises TableError."""
    table = _read(given)
    try:
        given.output.write_text(draw(table), encoding="utf-8")
    except OSError as error:
        raise TableError(f"{given.output} cannot be written: {error.strerror or error}") from None
    return Checked(figures(table), (), given.output)


def send(given: argparse.Namespace, target: Target) -> Answer:
    """Give a table to a machine that runs; not ok when a node did not take it. Raises CanductorError."""
    table = _read(given)
    params = {
        "axis": table.axis,
        "unit": str(table.unit),
        "positions": list(table.positions),
        "forward": list(table.forward),
        "reverse": list(table.reverse),
    }
    result = call(_patient(target), "table.send", params).result
    return _answer(result, [f"note: {note}" for note in result["notes"]], result["downloads"])


def remove(given: argparse.Namespace, target: Target) -> Answer:
    """Take a table away; not ok when a node keeps it. Raises CanductorError."""
    result = call(_patient(target), "table.remove", {"axis": given.axis}).result
    return _answer(result, [], result["downloads"])


def status(given: argparse.Namespace, target: Target) -> Answer:
    """Tell what there is; raises CanductorError."""
    result = call(target, "table.status", {}).result
    if given.axis is not None:
        result = {"axes": [axis for axis in result["axes"] if axis["axis"] == given.axis]}
        if not result["axes"]:
            raise TableError(f"the machine has no tables for an axis {given.axis}")
    return _answer(result, [])


def _patient(target: Target) -> Target:
    return Target(
        address=target.address,
        token=target.token,
        certificate=target.certificate,
        timeout_s=max(target.timeout_s, DOWNLOAD_TIMEOUT_S),
    )


def _read(given: argparse.Namespace) -> AxisTable:
    return read_table(given.file, axis=given.axis, comp_type=int(given.type), unit=given.unit)


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
    told = notes(table, rail.position_min, rail.position_max)
    if description.axis_tables is None:
        told.append("the machine takes no tables: add [axis_tables] to its configuration")
    elif len(table.positions) > description.axis_tables.points:
        told.append(f"the machine has room for {description.axis_tables.points} points: raise 'points'")
    return told


def _answer(result: Any, lines: list[str], downloads: Sequence[Mapping[str, Any]] = ()) -> Answer:
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
        lines.append(f"  to {'axle' if len(one['axles']) == 1 else 'axles'} {axles}: {one['told']}")
    if not result["axes"]:
        lines.append("no axis of this machine can have a table; add [axis_tables] to its configuration")
    return Answer(result, "\n".join(lines), ok=not problems)


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
