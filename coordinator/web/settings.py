"""Where the live page is served."""

import socket
from dataclasses import dataclass
from ipaddress import ip_address
from pathlib import Path


@dataclass(frozen=True, slots=True, kw_only=True)
class WebSettings:
    """An address, and TLS beyond loopback unless PLAIN was asked for in so many words."""

    host: str
    """An IP address."""
    port: int
    """0: any."""
    certificate: Path | None = None
    private_key: Path | None = None
    names: tuple[str, ...] = ()
    """Host names, in lower case, that the page answers to; to localhost and IP addresses it always does."""
    sessions: Path | None = None
    """File that keeps the sessions of browsers over a restart; None: they end with the server."""

    @property
    def on_loopback(self) -> bool:
        """Whether only this computer's programs reach it."""
        return ip_address(self.host).is_loopback

    @property
    def url(self) -> str:
        """What to type into a browser."""
        scheme = "http" if self.certificate is None else "https"
        host = self.host
        if self.names:
            host = self.names[0]
        elif ip_address(host).is_unspecified:
            host = _own_address(ip_address(host).version)
        host = f"[{host}]" if ":" in host else host
        return f"{scheme}://{host}:{self.port}/"


def _own_address(version: int) -> str:
    """Return the IP address (VERSION 4 or 6) by which the network reaches this computer, if there is one."""
    family, elsewhere, loopback = _ROUTES[version]
    with socket.socket(family, socket.SOCK_DGRAM) as probe:
        try:
            probe.connect((elsewhere, 9))  # sends nothing: the kernel only looks for the way
        except OSError:
            return loopback
        address: str = probe.getsockname()[0]
        return address


_ROUTES = {
    4: (socket.AF_INET, "192.0.2.1", "127.0.0.1"),
    6: (socket.AF_INET6, "2001:db8::1", "::1"),
}
"""By IP version: an address of the documentation blocks (RFC 5737, RFC 3849), and the loopback."""
