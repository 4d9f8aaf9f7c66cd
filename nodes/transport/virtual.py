"""Transport over the project's own virtual CAN bus (``nodes.virtual.hub``)."""

import os
import socket
from pathlib import Path

from nodes.support.errors import CanductorError
from nodes.transport.stream import READ_SIZE, RecordStream


class VirtualTransport(RecordStream):
    """A client of the virtual bus at PATH."""

    def __init__(self, path: str | Path, *, bitrate: int | None = None, read_size: int = READ_SIZE) -> None:
        """Connect; raises CanductorError when no bus is there. READ_SIZE: see RecordStream."""
        super().__init__(connect(path), f"virtual:{path}", bitrate=bitrate, read_size=read_size)

    def why_closed(self) -> str:
        """Return what ends a connection to a bus."""
        return "the bus ended the connection: it was stopped, or this program did not read for too long"


def connect(path: str | Path) -> socket.socket:
    """Return a stream socket connected to the bus at PATH; raises CanductorError."""
    sock = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    try:
        sock.connect(os.fspath(path))
    except OSError as error:
        sock.close()
        reason = error.strerror or str(error)  # a path that is too long gives no errno
        raise CanductorError(
            f"virtual:{path}: no virtual CAN bus answers there ({reason});"
            f" start one with 'canductor can inject -c {path}'"
        ) from error
    return sock
