"""The sockets of this user's machines."""

import os
import stat
from pathlib import Path
from typing import Final

_TEMPORARY: Final = "/tmp/canductor-{uid}"  # noqa: S108
"""Not the folder of TMPDIR: who starts a machine may have another one than who looks for it."""
SYSTEM_FOLDERS: Final = ("/run/user/{uid}/canductor", "/run/canductor", _TEMPORARY)
"""Where machines are looked for whatever the environment says; theirs may have been another."""


def socket_folder() -> Path:
    """Return the folder for the sockets of machines that this user starts."""
    base = os.environ.get("XDG_RUNTIME_DIR")
    return Path(base) / "canductor" if base else _of_user(_TEMPORARY)


def socket_folders() -> list[Path]:
    """Return the folders where machines of this user may have their sockets, however they were started."""
    return list(dict.fromkeys((socket_folder(), *map(_of_user, SYSTEM_FOLDERS))))


def folder_problem(folder: Path) -> str | None:
    """Return why no socket in FOLDER may be used; None: each may be, or there is no such folder.

    Where others can write, somebody may have put a socket there that answers in a machine's place.
    """
    try:
        status = folder.lstat()
    except FileNotFoundError:
        return None
    except OSError as error:
        return f"{folder} cannot be looked at: {(error.strerror or str(error)).lower()}"
    if stat.S_ISDIR(status.st_mode) and status.st_uid == os.geteuid() and not status.st_mode & 0o022:
        return None
    return f"{folder} must be a folder of this user's, no link, that nobody else may write to"


def folder_problems() -> list[str]:
    """Return why folders are not looked into."""
    return [problem for folder in socket_folders() if (problem := folder_problem(folder)) is not None]


def host_sockets() -> list[Path]:
    """Return the paths of the sockets of this user's machines; their processes may have ended."""
    found: dict[tuple[int, int], Path] = {}
    for folder in socket_folders():
        for path in _paths(folder):
            if (identity := _socket(path)) is not None:
                found.setdefault(identity, path)  # two paths may lead to one folder, as /var/run and /run
    return sorted(found.values())


def _of_user(folder: str) -> Path:
    return Path(folder.format(uid=os.geteuid()))


def _paths(folder: Path) -> list[Path]:
    if folder_problem(folder) is not None:
        return []
    try:
        return [path for path in folder.iterdir() if path.suffix == ".sock"]
    except OSError:  # there is none
        return []


def _socket(path: Path) -> tuple[int, int] | None:
    """Return what identifies the socket PATH; None: it is none."""
    try:
        status = path.stat()
    except OSError:
        return None
    return (status.st_dev, status.st_ino) if stat.S_ISSOCK(status.st_mode) else None
