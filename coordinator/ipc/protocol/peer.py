"""Whose the process at the other end of a Unix socket is, as the kernel says."""

import os
import socket
import struct
from typing import Final

_PEER: Final = struct.Struct("3i")
"""Of SO_PEERCRED: pid, uid, gid."""


def peer_of(opened: socket.socket) -> tuple[int, int]:
    """Return pid and uid of the process at the other end."""
    pid, uid, _ = _PEER.unpack(opened.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, _PEER.size))
    return pid, uid


def may_use(uid: int) -> bool:
    """Return whether the user UID may use this user's sockets."""
    return uid in (0, os.geteuid())


def may_serve(uid: int) -> bool:
    """Return whether this user's clients may use sockets of the user UID: root's may use everybody's.

    Those of others would refuse them (``may_use``): who answers there lies.
    """
    return may_use(uid) or os.geteuid() == 0
