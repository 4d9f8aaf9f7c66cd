"""Files with secrets, which only their owner may be able to read."""

import os
import stat
from pathlib import Path

from nodes.support.errors import CanductorError


def read_secret(path: Path, named: str) -> tuple[str, os.stat_result]:
    """Return the text of the file PATH and its status when it was read; messages call it NAMED.

    Raises CanductorError when it cannot be read, belongs to another user, or others may read or change it.
    """
    try:
        with path.open(encoding="utf-8") as file:
            status = os.fstat(file.fileno())
            text = file.read()
    except (OSError, UnicodeDecodeError) as error:
        raise CanductorError(f"{named} {path} cannot be read: {error}") from None
    if status.st_uid != os.geteuid() or stat.S_IMODE(status.st_mode) & 0o077:
        raise CanductorError(
            f"{named} {path} must belong to this user and be accessible to no other; chmod 600 it"
        )
    return text, status
