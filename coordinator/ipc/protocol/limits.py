"""What one client may cost, and why a connection ends."""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class EndReason:
    """Why the server ends a connection: CODE for programs, SENTENCE for people."""

    code: str
    sentence: str


@dataclass(frozen=True, slots=True, kw_only=True)
class Limits:
    """What one client may cost; everything beyond is refused, and a client that goes on is cut off."""

    message_bytes: int = 262_144
    """One message of a client, without its length or line end."""
    hello_bytes: int = 4_096
    """The same before the hello: strangers cost no more than that to decode."""
    nesting: int = 16
    """Lists and maps inside one another."""
    items: int = 4_096
    """Entries of one list or map."""
    values: int = 8_192
    """In all lists and maps of a message together."""
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
