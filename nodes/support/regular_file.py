"""Opening files of the disk, and nothing else that may have their name: FIFOs, devices, folders."""

import contextlib
import errno
import os
import stat
from pathlib import Path
from typing import Final

_AT_ONCE: Final = os.O_NONBLOCK | os.O_NOCTTY | os.O_CLOEXEC


def open_regular(path: str | Path, flags: int = os.O_RDONLY) -> int:
    """Return a descriptor of the regular file PATH; an opener for ``open``. Raises OSError for anything else.

    It never waits: opening a FIFO would, until somebody opens its other end. Devices are not opened at all,
    because that may act.
    """
    with contextlib.suppress(FileNotFoundError):  # it may be made by FLAGS
        _check(Path(path).stat())
    fd = os.open(path, flags | _AT_ONCE, 0o666)
    try:
        _check(os.fstat(fd))
    except OSError:
        os.close(fd)
        raise
    return fd


def read_regular(path: str | Path, bytes_max: int) -> bytes:
    """Return the first BYTES_MAX bytes of the regular file PATH; raises OSError."""
    with os.fdopen(open_regular(path), "rb") as file:
        return file.read(bytes_max)


def _check(status: os.stat_result) -> None:
    if not stat.S_ISREG(status.st_mode):
        raise OSError(errno.EINVAL, "Not a regular file")
