"""Keeps the page's sessions over a restart, as digests, in a file that only its owner can read."""

import json
from pathlib import Path
from typing import Any, Final

from coordinator.ipc.protocol.methods import Scope
from coordinator.support.atomic_file import atomic_write, sync_folder
from coordinator.web.access import SESSIONS_MAX, PageSession
from nodes.support.errors import CanductorError
from nodes.support.file_kind import exists
from nodes.support.plain_json import read_json
from nodes.support.secret_file import read_secret

VERSION: Final = 1


def read_sessions(path: Path) -> list[PageSession]:
    """Return the sessions in the file PATH, none when there is no file.

    Raises CanductorError when it cannot be read, others can read or change it, or it is none of ours.
    """
    if not exists(path):
        return []
    text, _ = read_secret(path, "the page's sessions")
    try:
        content = read_json(text)
        if content["version"] == VERSION:
            return [_session(one) for one in content["sessions"][:SESSIONS_MAX]]
    except (ValueError, TypeError, KeyError, AttributeError):
        pass
    raise CanductorError(f"{path} does not hold the page's sessions; remove it")


def write_sessions(path: Path, sessions: list[PageSession]) -> None:
    """Let PATH hold SESSIONS, or what it held before; raises CanductorError."""
    kept = [
        {
            "cookie": session.cookie.hex(),
            "key": session.key.hex(),
            "host": session.host,
            "scope": session.scope.word,
            "token": None if session.token is None else session.token.hex(),
            "used_s": session.used_s,
        }
        for session in sessions
    ]
    try:
        path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        atomic_write(path, json.dumps({"version": VERSION, "sessions": kept}).encode())
    except OSError as error:
        raise CanductorError(
            f"the page's sessions cannot be kept in {path}: {error.strerror or error}"
        ) from None


def remove_sessions(path: Path) -> None:
    """Remove the file PATH, if there is one: a disk without space allows that. Raises CanductorError."""
    try:
        path.lstat()  # a read-only disk does not even let what is not there be removed
        path.unlink()
        sync_folder(path.parent)
    except (FileNotFoundError, NotADirectoryError):
        pass
    except OSError as error:
        reason = (error.strerror or str(error)).lower()
        raise CanductorError(
            f"all browsers are signed out, but only until the next start: {path} cannot be removed: {reason};"
            " remove it before"
        ) from None


def _session(kept: dict[str, Any]) -> PageSession:
    return PageSession(
        cookie=bytes.fromhex(kept["cookie"]),
        key=bytes.fromhex(kept["key"]),
        host=str(kept["host"]),
        scope=Scope[kept["scope"].upper()],
        token=None if kept["token"] is None else bytes.fromhex(kept["token"]),
        used_s=float(kept["used_s"]),
    )
