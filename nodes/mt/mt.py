"""MT on the wire: the words of a transmission, and their transports. See firmware/objects/mt.h.

A word is an integer of 32 bits, here 0..2^32-1; the values of a table are signed.
"""

from collections.abc import Iterable, Iterator, Sequence
from enum import IntEnum
from typing import Final

from nodes.support.errors import CanductorError

ESC: Final = 0x80000000
LIT: Final = 0x80000001
C_MASK: Final = 0x10000000
C_START: Final = 0x20000000
C_CKLOW: Final = 0x30000000
C_CKHIGH: Final = 0x40000000
DATA_MASK: Final = 0x0FFFFFFF
COMMAND_MASK: Final = 0xF0000000

AXLES: Final = range(1, 29)
"""The bits of a mask; those of the command begin above them."""
VALUES: Final = range(-(1 << 28), 1 << 28)
"""Range of values. None looks like a command, ESC or LIT to a receiver that lost synchronization, and none
gets lost in a register that shows changes only."""
PAIRS_MAX: Final = DATA_MASK
WORD_BYTES: Final = 4
DIGEST_FACTOR: Final = 0x01000193
CLOSING: Final = (ESC, ESC, C_MASK)

_WORD: Final = 0xFFFFFFFF
_HALF: Final = 0xFFFF

Pair = tuple[int, int]


class MtStatus(IntEnum):
    """Status that a receiver reports of the last transmission to it."""

    OK = 0
    TRANSMITTING = 1
    CHECKSUM_ERROR = 2
    LENGTH_ERROR = 3


class MtError(CanductorError):
    """MT cannot carry a table or a mask."""


def mask_of(axles: Iterable[int]) -> int:
    """Return the mask that selects AXLES (1..28, at least one); raises MtError."""
    mask = 0
    for axle in axles:
        if axle not in AXLES:
            raise MtError(f"MT reaches the axles {AXLES[0]} to {AXLES[-1]}, not {axle}")
        mask |= 1 << (axle - 1)
    if not mask:
        raise MtError("a table is sent to at least one axle; name some")
    return mask


def checksum(pairs: Iterable[Pair]) -> int:
    """Return the sum of all values modulo 2^32."""
    return sum(x + y for x, y in pairs) & _WORD


def digest(pairs: Iterable[Pair]) -> int:
    """Return the digest that this project's receivers also report; it depends on the order of the values."""
    total = 0
    for value in _flat(pairs):
        total = (total * DIGEST_FACTOR + value) & _WORD
    return total


def transmission(pairs: Sequence[Pair], axles: Iterable[int]) -> list[int]:
    """Return the words that transfer PAIRS to AXLES; raises MtError for values that MT cannot carry.

    An empty table removes the table of a receiver.
    """
    mask = mask_of(axles)
    for number, pair in enumerate(pairs):
        for name, value in zip("XY", pair, strict=True):
            if value not in VALUES:
                raise MtError(
                    f"{name}[{number}] is {value}; MT sends whole numbers from {VALUES[0]} to {VALUES[-1]} "
                    "only: choose coarser units"
                )
    total = checksum(pairs)
    # The first ESC may be taken for a literal by a receiver that lost words, and the mask for a value; the
    # second ESC brings it back.
    words = [ESC, C_MASK, ESC, C_MASK | mask]
    words += [C_CKHIGH | total >> 16, C_CKLOW | total & _HALF, C_START | len(pairs)]
    last = words[-1]
    for value in _flat(pairs):
        word = value & _WORD
        if word == last:  # a receiver that polls a register would not see it
            words.append(LIT)
        words.append(word)
        last = word
    # The second ESC is for receivers that take the first for a literal; behind the mask nobody is selected,
    # and a register shows a change when the next transmission begins.
    words += CLOSING
    return words


def _flat(pairs: Iterable[Pair]) -> Iterator[int]:
    for pair in pairs:
        yield from pair


# -------------------------------------------------------------------------------------------- transports


def to_bytes(words: Iterable[int]) -> bytes:
    """Return WORDS as a stream of bytes, little endian."""
    return b"".join(word.to_bytes(WORD_BYTES, "little") for word in words)


def to_frames(words: Sequence[int]) -> list[bytes]:
    """Return the contents of the CAN frames of WORDS: two words each, one or two in the last."""
    return [to_bytes(words[at : at + 2]) for at in range(0, len(words), 2)]


def from_bytes(data: bytes) -> list[int]:
    """Return the complete words of DATA; remaining bytes are ignored."""
    whole = len(data) - len(data) % WORD_BYTES
    return [int.from_bytes(data[at : at + WORD_BYTES], "little") for at in range(0, whole, WORD_BYTES)]
