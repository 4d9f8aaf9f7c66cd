"""MT, receiving side in Python: the counterpart of firmware/objects/mt.h for hosts and tools.

Total: any word in any order is accepted; nothing raises, and memory is bounded by the capacity.
"""

from typing import Final

from nodes.mt.mt import (
    AXLES,
    C_CKHIGH,
    C_CKLOW,
    C_MASK,
    C_START,
    COMMAND_MASK,
    DATA_MASK,
    ESC,
    LIT,
    WORD_BYTES,
    MtError,
    MtStatus,
    Pair,
    digest,
)

_HALF: Final = 0xFFFF
_WORD: Final = 0xFFFFFFFF
_HIGH, _LOW = 1, 2
_SIGN: Final = 1 << 31


class MtReceiver:
    """The receiver of AXLE (1..28), with room for CAPACITY pairs; raises MtError for another axle.

    ``pairs``, ``checksum``, ``digest`` and ``generation`` are those of the table it keeps; ``status`` is that
    of the last transmission to it.
    """

    def __init__(self, axle: int, capacity: int) -> None:
        if axle not in AXLES:
            raise MtError(f"MT reaches the axles {AXLES[0]} to {AXLES[-1]}, not {axle}")
        self.axle = axle
        self.capacity = capacity
        self.status = MtStatus.OK
        self.pairs: tuple[Pair, ...] = ()
        self.checksum = 0
        self.digest = 0
        self.generation = 0
        self._in_values = self._literal = False
        self._selected = False
        self._announced_checksum = self._halves = 0
        self._announced = self._values = self._sum = 0
        self._shadow: list[int] = []

    def word(self, word: int) -> bool:
        """Process a word (0..2^32-1); return True when it completed a transmission whose table is kept."""
        if not self._in_values:
            self._command(word & COMMAND_MASK, word & DATA_MASK)
            return False
        if not self._literal and word == ESC:
            return self._end()
        if not self._literal and word == LIT:
            self._literal = True
            return False
        self._literal = False
        if self._selected:
            self._value(word)
        return False

    def _command(self, command: int, data: int) -> None:
        if command == C_MASK:
            self._selected = bool(data >> (self.axle - 1) & 1)
            self._halves = 0
        elif command == C_CKHIGH:
            self._announced_checksum = (data & _HALF) << 16
            self._halves = _HIGH
        elif command == C_CKLOW:
            self._announced_checksum = self._announced_checksum & ~_HALF | data & _HALF
            self._halves |= _LOW
        elif command == C_START:
            self._in_values = True
            if self._selected:
                self.status = MtStatus.TRANSMITTING
                self._announced, self._values, self._sum = data, 0, 0
                self._shadow = []

    def _value(self, word: int) -> None:
        if self._values < 2 * min(self._announced, self.capacity):
            self._shadow.append(word - ((word & _SIGN) << 1))
        self._values += 1
        self._sum = (self._sum + word) & _WORD

    def _end(self) -> bool:
        self._in_values = False
        if not self._selected:
            return False
        self.status = self._judge()
        if self.status is not MtStatus.OK:
            return False
        self.pairs = tuple(zip(self._shadow[::2], self._shadow[1::2], strict=True))
        self.checksum = self._sum
        self.digest = digest(self.pairs)
        self.generation = (self.generation + 1) & _WORD
        return True

    def _judge(self) -> MtStatus:
        if self._announced > self.capacity or self._values != 2 * self._announced:
            return MtStatus.LENGTH_ERROR
        if self._halves != _HIGH | _LOW or self._sum != self._announced_checksum:
            return MtStatus.CHECKSUM_ERROR
        return MtStatus.OK


class ByteWords:
    """Words from a serial line, which may lose bytes: after GAP_NS of silence the next byte starts a word."""

    def __init__(self, gap_ns: int) -> None:
        self.dropped = 0
        """Number of bytes of incomplete words."""
        self._gap_ns = gap_ns
        self._last_ns = 0
        self._partial = b""

    def receive(self, data: bytes, now_ns: int) -> list[int]:
        """Process DATA, received at NOW_NS; return the words that are now complete."""
        if self._partial and now_ns - self._last_ns > self._gap_ns:
            self.dropped += len(self._partial)
            self._partial = b""
        if data:
            self._last_ns = now_ns
        data = self._partial + data
        whole = len(data) - len(data) % WORD_BYTES
        self._partial = data[whole:]
        return [int.from_bytes(data[at : at + WORD_BYTES], "little") for at in range(0, whole, WORD_BYTES)]


class PolledRegister:
    """Words from a polled register: only a change counts as a word, and the first poll gives none."""

    def __init__(self) -> None:
        self._last: int | None = None

    def poll(self, value: int) -> int | None:
        """Process the register's present value; return it when it differs from that at the last poll."""
        before, self._last = self._last, value
        return value if before is not None and before != value else None
