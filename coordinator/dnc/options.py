"""Options of the serial line and of the protocol."""

from dataclasses import dataclass
from typing import Final

from nodes.support.errors import CanductorError
from nodes.support.option_values import UsageError

BAUD_RATES: Final = (110, 150, 300, 600, 1200, 2400, 4800, 9600, 19200, 38400, 57600, 115200, 230400)
TRANSMISSIONS_MAX: Final = 15
BLOCK_MAX: Final = 1024
PARITIES: Final = {"N": "none", "E": "even", "O": "odd"}


@dataclass(frozen=True, slots=True)
class SerialFrame:
    """One character on the line, as in 7E1."""

    data_bits: int = 7
    parity: str = "E"
    stop_bits: int = 1

    @property
    def bits(self) -> int:
        """Bits of one character with its start bit."""
        return 1 + self.data_bits + (self.parity != "N") + self.stop_bits

    def __str__(self) -> str:
        return f"{self.data_bits}{self.parity}{self.stop_bits}"


def read_frame(text: str) -> SerialFrame:
    """Return the frame of 7E1, 8N1 and the like; raises UsageError."""
    word = text.strip().upper()
    if len(word) != 3 or word[0] not in "78" or word[1] not in PARITIES or word[2] not in "12":
        raise UsageError(f"is '{text}', must be like 7E1 or 8N1: bits, parity, stop bits")
    return SerialFrame(int(word[0]), word[1], int(word[2]))


@dataclass(frozen=True, slots=True, kw_only=True)
class DncOptions:
    """Options of the protocol; times in seconds."""

    frame: SerialFrame = SerialFrame()
    baud: int = 9600
    dc1: bool = True
    """Send DC1 after each check character; received, it may be there or not."""
    avoid_control: bool = False
    """Send no check character below 20 hex;
    a received space for that, after CR LF, is always removed."""
    transmissions: int = TRANSMISSIONS_MAX
    """Of one block, the first included; old controls send 3 times."""
    block_max: int = BLOCK_MAX
    """Characters of one block's text, CR LF included."""
    answer_s: float = 8.0
    """Timeout of an answer to a block, and of the next block; then EOT is sent and the transfer fails."""
    decide_s: float = 30.0
    """Timeout of the answer to a header: a floppy drive may have to start."""
    character_s: float = 0.25
    """Silence that ends any message."""
    nak_quiet_s: float = 0.3
    """After NAK: repeat only if no other answer comes within this time."""
    paced: bool = False
    """The line transmits at BAUD at most: an answer that arrives before the block can have been sent is
    rejected. Not for sockets and pseudo-terminals."""

    def __post_init__(self) -> None:
        """Check; raises CanductorError."""
        for name, value, low, high in (
            ("baud", self.baud, 50, 4_000_000),
            ("transmissions", self.transmissions, 1, 100),
            ("block_max", self.block_max, 16, 65_536),
            ("answer_s", self.answer_s, 0.01, 86_400.0),
            ("decide_s", self.decide_s, 0.01, 86_400.0),
            ("character_s", self.character_s, 0.001, 60.0),
            ("nak_quiet_s", self.nak_quiet_s, 0.0, 60.0),
        ):
            if not low <= value <= high:
                raise CanductorError(f"{name} is {value}, must be from {low} to {high}")
        if self.answer_s <= self.character_s or self.answer_s <= self.nak_quiet_s:
            raise CanductorError(
                f"the timeout of an answer is {self.answer_s:g} s, must be longer than the silence that ends"
                f" a block ({self.character_s:g} s) and the wait after NAK ({self.nak_quiet_s:g} s)"
            )

    @property
    def character_time_s(self) -> float:
        """Of one character on the line."""
        return self.frame.bits / self.baud

    @property
    def settle_s(self) -> float:
        """Silence after which a block or answer is complete: the next character would have arrived."""
        return 1.5 * self.character_time_s

    @property
    def pair_s(self) -> float:
        """Maximum time between ETX and EOT: they are sent together, but adapters may split them."""
        return min(self.character_s, 0.02 + 4 * self.character_time_s)
