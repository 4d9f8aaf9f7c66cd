"""Keeps the accepted tables of a machine in a folder, one file an axis, so that they survive a restart."""

import json
import re
from pathlib import Path
from typing import Any, Final

from coordinator.support.atomic_file import atomic_write
from coordinator.tables.axis_table import AxisTable, TableError, Unit
from nodes.support.plain_json import read_json
from nodes.support.regular_file import read_regular
from nodes.support.state_folder import state_folder

_AXIS: Final = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,63}", re.ASCII)
_SUFFIX: Final = ".table.json"
FILE_BYTES_MAX: Final = 4_000_000
VERSION: Final = 1


def table_folder(machine: str) -> Path:
    """Return where the tables of MACHINE are kept."""
    return state_folder(machine) / "tables"


class TableStore:
    """The tables in FOLDER, which is made when the first is saved."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def save(self, table: AxisTable) -> None:
        """Keep TABLE in place of its axis's last one; whole, or not at all. Raises TableError."""
        path = self._path(table.axis)
        content = json.dumps(
            {
                "version": VERSION,
                "axis": table.axis,
                "unit": str(table.unit),
                "positions": table.positions,
                "forward": table.forward,
                "reverse": table.reverse,
            }
        )
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            atomic_write(path, content.encode())
        except OSError as error:
            raise TableError(
                f"the table cannot be kept in {self.folder}: {error.strerror or error}"
            ) from None

    def remove(self, axis: str) -> None:
        """Forget the table of AXIS, if there is one; raises TableError."""
        try:
            self._path(axis).unlink(missing_ok=True)
        except OSError as error:
            raise TableError(
                f"the table of axis {axis} cannot be removed from {self.folder}: {error.strerror or error}"
            ) from None

    def load(self) -> tuple[dict[str, AxisTable], list[str]]:
        """Return the tables by axis, and a sentence for each file that is none, or for the folder."""
        tables: dict[str, AxisTable] = {}
        problems: list[str] = []
        try:
            paths = sorted(path for path in self.folder.iterdir() if path.name.endswith(_SUFFIX))
        except FileNotFoundError:
            return {}, []
        except OSError as error:
            reason = (error.strerror or str(error)).lower()
            return {}, [f"the tables in {self.folder} cannot be read: {reason}"]
        for path in paths:
            try:
                table = _read(path)
            except TableError as error:
                problems.append(str(error))
                continue
            tables[table.axis] = table
        return tables, problems

    def _path(self, axis: str) -> Path:
        if not _AXIS.fullmatch(axis):
            raise TableError(f"'{axis}' is no name of an axis; use letters, digits, _ . and -")
        return self.folder / f"{axis}{_SUFFIX}"


def _read(path: Path) -> AxisTable:
    try:
        data = read_regular(path, FILE_BYTES_MAX + 1)
        table = None if len(data) > FILE_BYTES_MAX else _table(read_json(data))
    except (OSError, ValueError, TypeError, KeyError):
        table = None
    except TableError as error:
        raise TableError(f"{path}: {error}") from None
    if table is None or path.name != f"{table.axis}{_SUFFIX}":
        raise TableError(f"{path} is no kept table and was left out; remove it and send the table again")
    return table


def _table(raw: Any) -> AxisTable | None:
    if not isinstance(raw, dict) or raw.get("version") != VERSION:
        return None
    columns = {name: tuple(map(float, raw[name])) for name in ("positions", "forward", "reverse")}
    return AxisTable(axis=str(raw["axis"]), unit=Unit(raw["unit"]), **columns)
