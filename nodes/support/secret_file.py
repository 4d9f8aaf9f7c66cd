"""Files with secrets, which only their owner may be able to read."""

import os
import stat
from pathlib import Path
from typing import Final

from nodes.support.errors import CanductorError
from nodes.support.regular_file import open_regular

BYTES_MAX: Final = 1_000_000


def read_secret(path: Path, named: str) -> tuple[str, os.stat_result]:
    """Return the text of the file PATH and its status when it was read; messages call it NAMED.

    Raises CanductorError when it cannot be read, belongs to another user, or others may read or change it.
    """
    try:
        with os.fdopen(open_regular(path), "rb") as file:
            status = os.fstat(file.fileno())
            data = file.read(BYTES_MAX + 1)
        if len(data) > BYTES_MAX:
            raise CanductorError(f"{named} {path} has more than {BYTES_MAX} bytes; correct the name")
        text = data.decode("utf-8")
    except OSError as error:
        reason = (error.strerror or str(error)).lower()
        raise CanductorError(f"{named} {path} cannot be read: {reason}") from None
    except UnicodeDecodeError:
        raise CanductorError(f"{named} {path} cannot be read: it is not UTF-8 text") from None
    if status.st_uid != os.geteuid() or stat.S_IMODE(status.st_mode) & 0o077:
        raise CanductorError(
            f"{named} {path} must belong to this user and be accessible to no other; chmod 600 it"
        )
    return text, status
