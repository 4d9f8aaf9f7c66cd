"""Where the server listens, whom it lets in, and how much one client may cost."""

from dataclasses import dataclass, field
from pathlib import Path

from coordinator.ipc.protocol.methods import Scope


@dataclass(frozen=True, slots=True, kw_only=True)
class Limits:
    """What one client may cost; everything beyond is refused, and a client that goes on is cut off."""

    message_bytes: int = 262_144
    """One message of a client, without its length or line end."""
    nesting: int = 16
    """Lists and maps inside one another."""
    items: int = 4_096
    """Entries of one list or map."""
    values: int = 8_192
    """In all lists and maps of a message together: looking at them takes the control loop 2 ms."""
    message_timeout_s: float = 5.0
    """For a message to be complete after its first byte, and for the hello after connecting."""
    pending_requests: int = 256
    """Requests of one client that wait to be started; more are answered with "busy"."""
    running_requests: int = 64
    """Requests of one client that run; others wait."""
    subscriptions: int = 16
    filters: int = 64
    """Globs of one subscription."""
    output_bytes: int = 65_536
    """Beyond this much unsent, requests wait, updates are merged, notifications are dropped."""
    output_bytes_max: int = 4_194_304
    """Beyond this much unsent, the client is cut off: it asks without reading the answers."""
    notifications: int = 256
    """Notifications that wait for one client; the oldest are dropped and counted."""


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
    """As of TCP, for clients that come by other doors (the live page) when there is no TCP."""
    connections_max: int = 512
    tcp_connections_max: int = 256
    """Of those; a flood from the network leaves room for the owner's programs."""
    limits: Limits = field(default_factory=Limits)
