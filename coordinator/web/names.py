"""The names that the page answers to, and where a request says that it comes from.

A page of any website can make its visitor's browser connect here. So the Host by which the browser found us
is checked, and the Origin of the page that asks. A name that anybody on the network can make mean another
computer ("DNS rebinding"; names in .local are such) is answered to only when it was configured.
"""

import re
from collections.abc import Iterable
from ipaddress import ip_address
from typing import Final
from urllib.parse import urlsplit

_HOST: Final = re.compile(r"(?P<name>\[[0-9a-f:.]+\]|[a-z0-9_.-]+)(:[0-9]*)?", re.ASCII)


def is_known_host(host: str, names: Iterable[str]) -> bool:
    """Return whether HOST, as a browser sends it, is an IP address, localhost or one of NAMES.

    NAMES are in lower case.
    """
    parts = _HOST.fullmatch(host.lower())
    if parts is None:
        return False
    name = parts["name"]
    if name == "localhost" or name in names:
        return True
    try:
        ip_address(name.removeprefix("[").removesuffix("]"))
    except ValueError:
        return False
    return True


def is_own_origin(origin: str | None, host: str) -> bool:
    """Return whether ORIGIN, as a browser sends it, is the page that was found under HOST."""
    if origin is None:
        return False
    try:
        parts = urlsplit(origin)
    except ValueError:
        return False
    return parts.scheme in ("http", "https") and parts.netloc.lower() == host.lower()
