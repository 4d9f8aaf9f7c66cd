"""Tokens of the received data."""

from dataclasses import dataclass
from enum import Enum, auto


class Kind(Enum):
    """Kinds of tokens."""

    BLOCK = auto()
    HEADER = auto()
    ACK = auto()
    NAK = auto()
    ETX = auto()
    END = auto()
    """ETX EOT."""
    EOT = auto()
    DIRECTORY = auto()
    HOLD = auto()
    """DC3: the other side asks for a pause."""
    GO_ON = auto()
    """DC1 by itself."""
    DAMAGED = auto()
    """A damaged block."""
    OVERRUN = auto()
    """The other side continued without an answer to a damaged block: it took noise for the answer."""
    CONFLICT = auto()
    """NAK and another answer to one block: one of them is noise."""
    NOISE = auto()
    """Noise; CONTENT is an ACK if the noise contained one."""


@dataclass(frozen=True, slots=True)
class Token:
    """A token and the time of its last character."""

    kind: Kind
    at_s: float
    content: bytes = b""
    """Of a block or header: what is between its first character and ETB."""
    check: int = 0
    """The received block check."""
    reason: str = ""
    """Of a damaged block: the reason, which completes 'the block ...'."""
