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
    try:
        return [path for path in folder.iterdir() if path.suffix == ".sock"]
    except OSError:  # there is none, or it is another user's
        return []


def _socket(path: Path) -> tuple[int, int] | None:
    """Return what identifies the socket PATH; None: it is none."""
    try:
        status = path.stat()
    except OSError:
        return None
    return (status.st_dev, status.st_ino) if stat.S_ISSOCK(status.st_mode) else None
