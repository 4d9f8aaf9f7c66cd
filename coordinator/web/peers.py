"""Who is at the other end: the user whose program connects over loopback, and the names we answer to.

A page of any website can make its visitor's browser connect to loopback. So the browser's word on where the
page comes from is checked (Origin), and the name by which it found us (Host): a foreign name that was made to
point here ("DNS rebinding") is not ours.
"""

import os
import socket
import sys
from collections.abc import Iterable
from ipaddress import IPv4Address, IPv6Address, ip_address
from pathlib import Path
from urllib.parse import urlsplit

_TABLES = {4: Path("/proc/net/tcp"), 6: Path("/proc/net/tcp6")}


def own_names() -> frozenset[str]:
    """Return the names of this computer that need no name server, in lower case."""
    name = socket.gethostname().lower()
    short = name.partition(".")[0]
    return frozenset(("localhost", name, short, f"{short}.local"))


def is_own_host(host: str, names: Iterable[str]) -> bool:
    """Tell whether HOST, as a browser sends it, is one of NAMES or an address: those nobody can rebind."""
    try:
        name = urlsplit(f"//{host}").hostname or ""
    except ValueError:
        return False
    if name in names:
        return True
    try:
        ip_address(name)
    except ValueError:
        return False
    return True


def is_own_origin(origin: str | None, host: str) -> bool:
    """Tell whether ORIGIN, as a browser sends it, is the page that was found under HOST."""
    if origin is None:
        return False
    try:
        parts = urlsplit(origin)
    except ValueError:
        return False
    return parts.scheme in ("http", "https") and parts.netloc.lower() == host.lower()


def is_own_program(peer: tuple[str, int], here: tuple[str, int]) -> bool:
    """Tell whether the program at PEER runs on this computer for this user, or root, by the kernel's word.

    HERE is our end of the connection. Reads a table of the kernel: not for the control loop.
    """
    address = ip_address(peer[0])
    mapped = address.ipv4_mapped if isinstance(address, IPv6Address) else None
    if not (mapped or address).is_loopback:
        return False
    uid = _uid_of(_words(address, peer[1]), _words(ip_address(here[0]), here[1]), _TABLES[address.version])
    return uid in (0, os.geteuid())


def _uid_of(local: str, remote: str, table: Path) -> int | None:
    """Return whose socket goes from LOCAL to REMOTE; None: there is none in TABLE."""
    try:
        with table.open(encoding="ascii") as lines:
            next(lines)
            for line in lines:
                columns = line.split()
                if columns[1] == local and columns[2] == remote:
                    return int(columns[7])
    except (OSError, StopIteration):
        return None
    return None


def _words(address: IPv4Address | IPv6Address, port: int) -> str:
    """Write an address as the kernel's tables do: words of 32 bits in the computer's own order."""
    packed = address.packed
    words = (int.from_bytes(packed[at : at + 4], sys.byteorder) for at in range(0, len(packed), 4))
    return "".join(f"{word:08X}" for word in words) + f":{port:04X}"
