"""What may be on a line, once its bytes are read."""

from dataclasses import dataclass
from enum import Enum, auto


class Kind(Enum):
    """What a token is."""

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
    """A block it was, but not as it was sent."""
    OVERRUN = auto()
    """The other side went on without an answer to a damaged block: it took noise for one."""
    CONFLICT = auto()
    """NAK and another answer to one block: one of them is noise."""
    NOISE = auto()
    """What means nothing; CONTENT is an ACK if one was in it."""


@dataclass(frozen=True, slots=True)
class Token:
    """What was on the line, and when its last character was."""

    kind: Kind
    at_s: float
    content: bytes = b""
    """Of a block or header: what is between its first character and ETB."""
    check: int = 0
    """The block check that came."""
    reason: str = ""
    """Of what is damaged: why, to complete 'the block ...'."""
