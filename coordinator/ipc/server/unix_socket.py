"""Unix sockets of the service: for the owner's programs only."""

import asyncio
import os
import socket
import struct
from pathlib import Path
from typing import Final

from nodes.support.errors import CanductorError

BACKLOG: Final = 128
_PEER: Final = struct.Struct("3i")
"""Of SO_PEERCRED: pid, uid, gid."""


async def listen_at(path: Path) -> socket.socket:
    """Return a socket of mode 0600 that is bound to PATH; raises CanductorError."""
    await asyncio.to_thread(_make_way, path)
    listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    try:
        os.fchmod(listener.fileno(), 0o600)  # before there is a name, so that nobody can be faster
        listener.bind(str(path))
    except OSError as error:
        listener.close()
        raise CanductorError(f"the socket {path} cannot be opened: {error.strerror or error}") from None
    return listener


def peer_of(opened: socket.socket) -> tuple[int, int]:
    """Return pid and uid of the process at the other end."""
    pid, uid, _ = _PEER.unpack(opened.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, _PEER.size))
    return pid, uid


def may_use(uid: int) -> bool:
    """Return whether the user UID may use this user's sockets."""
    return uid in (0, os.geteuid())


def _make_way(path: Path) -> None:
    """Make the folder of PATH, and remove a socket that a dead coordinator left there."""
    try:
        path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        if not path.is_socket():
            if path.exists():
                raise CanductorError(f"{path} exists and is not a socket; choose another path or remove it")
            return
        with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as probe:
            probe.settimeout(1.0)
            try:
                probe.connect(str(path))
            except ConnectionRefusedError:
                path.unlink()
                return
    except OSError as error:
        raise CanductorError(f"the socket {path} cannot be opened: {error.strerror or error}") from None
    raise CanductorError(f"another coordinator serves at {path}; stop it, or choose another path")
