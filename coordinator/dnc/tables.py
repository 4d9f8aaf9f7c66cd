"""Validates received tables (file code S) as imported tables are."""

import tempfile
from pathlib import Path

from coordinator.tables.files import read_table
from nodes.support.errors import CanductorError

_ANY_AXIS = "x"
"""The axis of a table is chosen when it is sent to a machine."""


def check_table(content: bytes, name: str) -> None:
    """Raise CanductorError, about NAME, unless CONTENT is a valid table: CSV by its name, else COMP_FILE."""
    with tempfile.TemporaryDirectory(prefix="canductor-") as folder:
        path = Path(folder) / "table"
        path.write_bytes(content)
        try:
            read_table(path, axis=_ANY_AXIS, is_csv=name.lower().endswith(".csv"))
        except CanductorError as error:
            raise CanductorError(str(error).replace(str(path), name)) from None
