"""Reads axis tables from files: LinuxCNC's COMP_FILE of both types, and CSV with units in its header."""

import csv
import re
import stat
from collections.abc import Iterator
from pathlib import Path
from typing import Final

from coordinator.tables.axis_table import POINTS, AxisTable, TableError, Unit, problem_of
from nodes.support.numbers import read_decimal
from nodes.support.terminal import printable

FILE_BYTES_MAX: Final = 4_000_000
LENGTHS: Final = {"mm": 1.0, "um": 1e-3, "nm": 1e-6, "inch": 25.4}
"""What a unit of a file is in mm."""
ANGLES: Final = {"deg": 1.0, "arcmin": 1 / 60, "arcsec": 1 / 3600}
"""Likewise in degrees."""
UNITS: Final = (*LENGTHS, *ANGLES)
ACTUAL, TRIM = 0, 1
"""COMP_FILE_TYPE: the actual positions at a nominal one, or what is to be added there."""
_NUMBER: Final = re.compile(r"[-+]?(\d+(?:\.\d*)?|\.\d+)([eE][-+]?\d{1,3})?", re.ASCII)
_NUMBER_CHARS_MAX: Final = 40
_COMMENTS: Final = ("#", ";")
_COLUMNS: Final = ("position", "forward", "reverse")

_Point = tuple[int, float, float, float]
"""Line, position, forward and reverse correction."""


def read_table(
    path: Path, *, axis: str, comp_type: int = ACTUAL, unit: str = "mm", is_csv: bool | None = None
) -> AxisTable:
    """Read the table of AXIS from PATH; raises TableError with file and line.

    COMP_TYPE and UNIT (of all numbers) are those of a COMP_FILE; a CSV file says it all itself. IS_CSV: None
    means by the name (.csv).
    """
    if unit not in UNITS or comp_type not in (ACTUAL, TRIM):
        raise TableError(
            f"a table in '{unit}' of type {comp_type}; units are {', '.join(UNITS)}, types 0 and 1"
        )
    lines = _lines(path)
    if path.suffix.lower() == ".csv" if is_csv is None else is_csv:
        kind, points = _csv_points(path, lines)
    else:
        kind, points = _kind(unit), list(_comp_points(path, lines, comp_type, unit))
    return _checked(path, axis, kind, points)


def _lines(path: Path) -> list[str]:
    try:
        # Looked at before it is opened: a FIFO may block, and a device never end.
        if not stat.S_ISREG(path.stat().st_mode):
            raise TableError(f"{path} is not a regular file; give a COMP_FILE or CSV")
        with path.open("rb") as file:
            data = file.read(FILE_BYTES_MAX + 1)
        if len(data) > FILE_BYTES_MAX:
            raise TableError(
                f"{path}: more than {FILE_BYTES_MAX} bytes are no table of an axis; check the name"
            )
        return data.decode("utf-8-sig").splitlines()
    except OSError as error:
        raise TableError(f"{path} cannot be read: {error.strerror or error}") from None
    except UnicodeDecodeError:
        raise TableError(f"{path} is no text file; give a COMP_FILE or CSV") from None


def _kind(unit: str) -> Unit:
    return Unit.MM if unit in LENGTHS else Unit.DEG


def _factor(unit: str) -> float:
    return (LENGTHS | ANGLES)[unit]


def _number(path: Path, line: int, text: str) -> float:
    text = text.strip()
    value = read_decimal(text)
    if value is None:
        shown = printable(text[:_NUMBER_CHARS_MAX])
        raise TableError(f"{path}:{line}: '{shown}' is no number; write it as 12.5")
    return value


# ------------------------------------------------------------------------------------------- COMP_FILE


def _comp_points(path: Path, lines: list[str], comp_type: int, unit: str) -> Iterator[_Point]:
    """Yield the points; a correction is what is to be added: nominal minus actual."""
    factor = _factor(unit)
    for line, text in enumerate(lines, 1):
        words = re.split(r"[#;]", text, maxsplit=1)[0].split()
        if not words:
            continue
        if len(words) != len(_COLUMNS):
            raise TableError(f"{path}:{line}: {len(words)} values, must be three: nominal, forward, reverse")
        nominal, forward, reverse = (_number(path, line, word) for word in words)
        if comp_type == ACTUAL:
            forward, reverse = nominal - forward, nominal - reverse
        yield line, nominal * factor, forward * factor, reverse * factor


# ------------------------------------------------------------------------------------------------- CSV


def _csv_points(path: Path, lines: list[str]) -> tuple[Unit, list[_Point]]:
    """Read ``position_mm,forward_um,reverse_um``: corrections; without reverse, both sides are the same."""
    numbered = [(n, t) for n, t in enumerate(lines, 1) if t.strip() and not t.lstrip().startswith(_COMMENTS)]
    if not numbered:
        raise TableError(f"{path} is empty; its first line is position_mm,forward_um,reverse_um")
    head_line, head = numbered[0]
    separator = ";" if ";" in head else "\t" if "\t" in head else ","
    columns = _columns(path, head_line, _cells(path, head_line, head, separator))
    points: list[_Point] = []
    for line, text in numbered[1:]:
        cells = _cells(path, line, text, separator)
        if len(cells) <= max(index for index, _ in columns.values()):
            raise TableError(f"{path}:{line}: {len(cells)} values, fewer than its first line names")
        value = {
            name: _number(path, line, cells[index]) * _factor(unit) for name, (index, unit) in columns.items()
        }
        points.append((line, value["position"], value["forward"], value.get("reverse", value["forward"])))
    return _kind(columns["position"][1]), points


def _cells(path: Path, line: int, text: str, separator: str) -> list[str]:
    try:
        return next(csv.reader([text], delimiter=separator))
    except csv.Error as error:
        raise TableError(f"{path}:{line}: this is no line of CSV ({error})") from None


def _columns(path: Path, line: int, cells: list[str]) -> dict[str, tuple[int, str]]:
    """Return index and unit of each column; others are left alone."""
    found: dict[str, tuple[int, str]] = {}
    for index, cell in enumerate(cells):
        name, _, unit = cell.strip().lower().rpartition("_")
        if name in _COLUMNS:
            if unit not in UNITS or name in found:
                raise TableError(
                    f"{path}:{line}: the column '{name}' must be there once, with a unit of "
                    f"{', '.join(UNITS)}"
                )
            found[name] = (index, unit)
    if "position" not in found or "forward" not in found:
        raise TableError(
            f"{path}:{line}: the first line must name the columns, such as position_mm,forward_um,reverse_um"
        )
    if len({_kind(unit) for _, unit in found.values()}) > 1:
        raise TableError(f"{path}:{line}: lengths and angles in one table; use units of one kind")
    return found


# ------------------------------------------------------------------------------------------------ both


def _checked(path: Path, axis: str, kind: Unit, points: list[_Point]) -> AxisTable:
    """Return the table; errors of a point name its line."""
    if len(points) not in POINTS:
        raise TableError(f"{path}: {len(points)} points; a table has {POINTS[0]} to {POINTS[-1]}")
    before = None
    for line, *values in points:
        point = (values[0], values[1], values[2])
        if problem := problem_of(kind, point, before):
            raise TableError(f"{path}:{line}: {problem}")
        before = point
    _, positions, forward, reverse = zip(*points, strict=True)
    return AxisTable(axis=axis, unit=kind, positions=positions, forward=forward, reverse=reverse)
