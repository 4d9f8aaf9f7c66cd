"""Where the live page is served."""

from dataclasses import dataclass
from ipaddress import ip_address
from pathlib import Path
from socket import gethostname


@dataclass(frozen=True, slots=True, kw_only=True)
class WebSettings:
    """An address, and TLS beyond loopback unless PLAIN was asked for in so many words."""

    host: str
    """An IP address."""
    port: int
    """0: any."""
    certificate: Path | None = None
    private_key: Path | None = None

    @property
    def on_loopback(self) -> bool:
        """Whether only this computer's programs reach it."""
        return ip_address(self.host).is_loopback

    @property
    def url(self) -> str:
        """What to type into a browser."""
        scheme = "http" if self.certificate is None else "https"
        host = f"[{self.host}]" if ":" in self.host else self.host
        if ip_address(self.host).is_unspecified:
            host = gethostname()
        return f"{scheme}://{host}:{self.port}/"
