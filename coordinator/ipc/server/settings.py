"""Where the server listens and whom it lets in."""

from dataclasses import dataclass, field
from pathlib import Path

from coordinator.ipc.protocol.limits import Limits
from coordinator.ipc.protocol.methods import Scope


@dataclass(frozen=True, slots=True, kw_only=True)
class TcpSettings:
    """A TCP port. Either TLS, or a loopback address with an explicit ``plain_on_loopback``."""

    host: str
    port: int
    tokens: Path
    """File of the tokens, mode 0600 (docs/ipc.md)."""
    certificate: Path | None = None
    """PEM with the chain; with ``private_key``: TLS 1.2 or later."""
    private_key: Path | None = None
    plain_on_loopback: bool = False


@dataclass(frozen=True, slots=True, kw_only=True)
class IpcSettings:
    """Where an IpcServer listens; without TCP unless asked."""

    unix_path: Path | None
    unix_scope: Scope = Scope.ADMIN
    """What the owner's programs may do on the Unix socket, without a token."""
    tcp: TcpSettings | None = None
    tokens: Path | None = None
    """As of TCP, for clients that come in otherwise (by the live page) when there is no TCP."""
    connections_max: int = 512
    tcp_connections_max: int = 256
    """Of those; a flood from the network leaves room for the owner's programs."""
    limits: Limits = field(default_factory=Limits)
