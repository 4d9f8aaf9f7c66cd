"""What is at a path that a user names; ``Path.exists`` and the like make a bug of some answers.

All raise CanductorError when the path cannot be looked at: it leads through another user's folder, or has a
name that is too long. Of these pathlib makes an OSError or False, by Python's version.
"""

import os
import stat
from pathlib import Path

from nodes.support.errors import CanductorError


def exists(path: str | Path) -> bool:
    """Return whether there is something at PATH."""
    return _status(path) is not None


def is_folder(path: str | Path) -> bool:
    """Return whether PATH is a folder, or leads to one."""
    status = _status(path)
    return status is not None and stat.S_ISDIR(status.st_mode)


def is_regular(path: str | Path) -> bool:
    """Return whether PATH is a regular file, or leads to one."""
    status = _status(path)
    return status is not None and stat.S_ISREG(status.st_mode)


def _status(path: str | Path) -> os.stat_result | None:
    try:
        return Path(path).stat()
    except (FileNotFoundError, NotADirectoryError):
        return None
    except OSError as error:
        reason = (error.strerror or str(error)).lower()
    except ValueError:  # it contains NUL
        reason = "no file can have this name"
    raise CanductorError(f"'{path}' cannot be looked at: {reason}")
