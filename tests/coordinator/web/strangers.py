"""Another user of this computer: a child process under another uid that sends a burst and closes."""

import os
import socket
from collections.abc import Callable

import pytest

STRANGER_UID = 65_534
"""The user nobody."""
SEND_LIMIT_S = 10.0
"""For the burst to be taken; a server may refuse after its first bytes."""


def as_stranger(act: Callable[[], None]) -> None:
    """Run ACT in a child process as the user nobody, and wait for its end; skips when this is not root.

    ACT may do nothing but system calls, since the child is a fork of a process that may have threads. The
    loop stands meanwhile: a server on it finds what ACT sent when ACT's sockets are closed.
    """
    if os.geteuid() != 0:
        pytest.skip("only root can act as another user")
    child = os.fork()
    if child == 0:
        status = 1
        try:
            os.setgroups([])
            os.setresgid(STRANGER_UID, STRANGER_UID, STRANGER_UID)
            os.setresuid(STRANGER_UID, STRANGER_UID, STRANGER_UID)
            act()
            status = 0
        finally:
            os._exit(status)
    _, status = os.waitpid(child, 0)
    assert status == 0, "the stranger could not send what it was to send"


def send_and_close(family: socket.AddressFamily, address: object, data: bytes) -> None:
    """Send DATA to ADDRESS and close at once, without reading: the kernel forgets whose socket it was."""
    with socket.socket(family, socket.SOCK_STREAM) as opened:
        opened.settimeout(SEND_LIMIT_S)
        opened.connect(address)  # type: ignore[arg-type]
        try:
            opened.sendall(data)
        except (BrokenPipeError, ConnectionResetError):
            return  # refused before all of it was sent


def masked_frame(payload: bytes, opcode: int = 1) -> bytes:
    """Return a WebSocket frame as a client sends it (RFC 6455), masked with zeros."""
    size = len(payload)
    if size < 126:
        length = bytes([0x80 | size])
    elif size < 65_536:
        length = bytes([0x80 | 126]) + size.to_bytes(2, "big")
    else:
        length = bytes([0x80 | 127]) + size.to_bytes(8, "big")
    return bytes([0x80 | opcode]) + length + bytes(4) + payload
