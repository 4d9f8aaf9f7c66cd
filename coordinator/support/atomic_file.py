"""Files that are written whole or not at all."""

import contextlib
import errno
import fcntl
import os
import stat
import tempfile
from pathlib import Path
from typing import Final

_PART: Final = ".part"


def atomic_write(path: Path, data: bytes, *, like: os.stat_result | None = None) -> None:
    """Let PATH hold DATA, or what it held before, whatever happens meanwhile; raises OSError.

    A power cut, too: the new content is on the disk before the name leads to it. Only the user may read a new
    file; LIKE gives it the mode and, where allowed, the owner of another one. The last step, which brings the
    name to the disk, may fail as well: then PATH holds DATA.
    """
    prefix = f".{path.name}."
    remove_unfinished(path.parent, prefix)
    handle, name = tempfile.mkstemp(prefix=prefix, suffix=_PART, dir=path.parent)
    try:
        with os.fdopen(handle, "wb") as file:
            claim(handle)
            file.write(data)
            if like is not None:
                _make_like(handle, like)
            file.flush()
            os.fsync(handle)
            Path(name).replace(path)
    except BaseException:
        with contextlib.suppress(OSError):  # a disk that became read-only: the first error says so
            Path(name).unlink(missing_ok=True)
        raise
    sync_folder(path.parent)


def replace_content(path: Path, data: bytes) -> None:
    """Do as ``atomic_write``, and let a file that exists be as it was: its mode, its owner, links to it.

    Of a symbolic link the file that it leads to is replaced. Raises OSError, also for a write-protected file.
    """
    try:
        like = path.stat()
    except FileNotFoundError:
        like = None
    if like is not None and not os.access(path, os.W_OK):
        raise PermissionError(errno.EACCES, "it is write-protected")
    atomic_write(path.resolve(), data, like=like)


def sync_folder(path: Path) -> None:
    """Bring the names in the folder PATH to the disk; raises OSError."""
    folder = os.open(path, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(folder)
    finally:
        os.close(folder)


def remove_unfinished(folder: Path, prefix: str) -> None:
    """Remove what processes left in FOLDER that were killed: files PREFIX*.part that nobody has claimed."""
    with contextlib.suppress(OSError), os.scandir(folder) as entries:
        for entry in entries:
            if entry.name.startswith(prefix) and entry.name.endswith(_PART):
                with contextlib.suppress(OSError):
                    _remove_unclaimed(entry.path)


def _remove_unclaimed(part: str) -> None:
    handle = os.open(part, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK)
    try:
        if stat.S_ISREG(os.fstat(handle).st_mode) and claim(handle):
            Path(part).unlink()
    finally:
        os.close(handle)


def claim(handle: int) -> bool:
    """Lock the open file HANDLE until it is closed; return whether nobody else has."""
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:  # also where the disk has no locks: then nothing is removed
        return False
    return True


def _make_like(handle: int, like: os.stat_result) -> None:
    if (like.st_uid, like.st_gid) != (os.geteuid(), os.getegid()):
        with contextlib.suppress(PermissionError):
            os.fchown(handle, like.st_uid, like.st_gid)
    os.fchmod(handle, stat.S_IMODE(like.st_mode))
