"""Addresses of machines: paths of sockets, tcp:// and tls://."""

import socket
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import urlsplit

from nodes.support.errors import CanductorError
from nodes.support.host_sockets import folder_problems, host_sockets, socket_folders


@dataclass(frozen=True, slots=True)
class Address:
    """A Unix socket (PATH) or a TCP port (HOST, PORT), with or without TLS."""

    path: Path | None = None
    host: str = ""
    port: int = 0
    tls: bool = False

    def __str__(self) -> str:
        if self.path is not None:
            return str(self.path)
        return f"{'tls' if self.tls else 'tcp'}://{self.host}:{self.port}"


def read_address(text: str | None) -> Address:
    """Read a path, ``tcp://HOST:PORT`` or ``tls://HOST:PORT``; None: the only machine of this user.

    Raises CanductorError.
    """
    if text is None:
        return _only_machine()
    scheme, separator, _ = text.partition("://")
    if not separator:
        return Address(path=Path(text.removeprefix("unix:")))
    try:
        parts = urlsplit(text)
        host, port = parts.hostname, parts.port
    except ValueError:
        host, port = None, None
    if scheme not in ("tcp", "tls") or not host or not port:
        raise CanductorError(
            f"'{text}' is not an address; it must be a path, tcp://HOST:PORT or tls://HOST:PORT"
        )
    return Address(host=host, port=port, tls=scheme == "tls")


def _only_machine() -> Address:
    found = host_sockets()
    if len(found) > 1:  # a single one is not probed: connecting shows the same, and a stop must not wait
        found = [path for path in found if _is_served(path)] or found[:1]
    if len(found) == 1:
        return Address(path=found[0])
    if not found:
        folders = ", ".join(map(str, socket_folders()))
        reasons = [f"no machine of this user runs here: there is no socket in {folders}", *folder_problems()]
        raise CanductorError(f"{'; '.join(reasons)}; name one with --at ADDRESS")
    raise CanductorError(f"several machines run here; name one with --at: {', '.join(map(str, found))}")


def _is_served(path: Path) -> bool:
    """Return whether somebody may be there: only a socket that a program left behind refuses. Never waits."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as probe:
        probe.setblocking(False)
        try:
            probe.connect(str(path))
        except (ConnectionRefusedError, FileNotFoundError):
            return False
        except OSError:  # too many wait there, or it may not be asked: it is up to the user to choose
            return True
    return True
