"""Tables that come by file code S: validated as imported ones are, before they are kept."""

import tempfile
from pathlib import Path

from coordinator.tables.files import read_table
from nodes.support.errors import CanductorError

_ANY_AXIS = "x"
"""Which axis a table is for is said when it is sent to one."""


def check_table(content: bytes, name: str) -> None:
    """Raise CanductorError, about NAME, unless CONTENT is a sound table: CSV by its name, else COMP_FILE."""
    with tempfile.TemporaryDirectory(prefix="canductor-") as folder:
        path = Path(folder) / "table"
        path.write_bytes(content)
        try:
            read_table(path, axis=_ANY_AXIS, is_csv=name.lower().endswith(".csv"))
        except CanductorError as error:
            raise CanductorError(str(error).replace(str(path), name)) from None
