"""What the fuzzers of MT run: any bytes for the receivers in Python and in C, which must agree on everything.

The firmware's receiver is the one that virtual nodes run. fuzz_mt.c looks at it alone, under the sanitizers.
"""

from typing import Any, Final

from nodes.mt.mt import AXLES, MtStatus, digest, transmission
from nodes.virtual._sim import ffi, lib
from tests.nodes.mt.receiver import ByteWords, MtReceiver, PolledRegister
from tests.nodes.mt.receivers import FirmwareReceiver

GAP: Final = 100
ROOM_MAX: Final = 12
LAST: Final = ((1, -2), (3, 4), (3, 4))
SHORT: Final = (
    0x80000000,
    0x80000001,
    0x10000000,
    0x20000000,
    0x30000000,
    0x40000000,
    0xFFFFFFF0,
    0x00000000,
)
"""Words that an input can name in two bytes: what MT's own begin with, and small values."""


class Pair:
    """One receiver of each language, and the ways to them."""

    def __init__(self, axle: int, room: int, now: int) -> None:
        self.python, self.firmware = MtReceiver(axle, room), FirmwareReceiver(axle, room)
        self._bytes, self._raw_bytes = ByteWords(GAP), ffi.new("struct mt_bytes *", {"gap": GAP})
        self._register, self._raw_register = PolledRegister(), ffi.new("struct mt_register *")
        self._now = now

    def words(self, words: list[int]) -> None:
        """Give both WORDS."""
        for word in words:
            before = self.python.generation
            kept = self.python.word(word)
            assert kept == self.firmware.word(word)
            assert self.python.generation == before + kept
            assert self._seen(self.python) == self._seen(self.firmware)
            if kept:
                assert self.python.pairs == self.firmware.pairs
                assert self.python.digest == digest(self.python.pairs)
                assert len(self.python.pairs) <= self.python.capacity

    def bytes(self, data: bytes) -> None:
        """Give both DATA as from a serial line."""
        word: Any = ffi.new("uint32_t *")
        now32 = self._now & 0xFFFFFFFF
        raw = [int(word[0]) for byte in data if lib.mt_byte(self._raw_bytes, byte, now32, word)]
        words = self._bytes.receive(data, self._now)
        assert words == raw
        self.words(words)

    def pause(self, ticks: int) -> None:
        """Let time go by."""
        self._now += ticks

    def poll(self, value: int) -> None:
        """Poll a register that holds VALUE."""
        word = self._register.poll(value)
        assert (word is not None) == bool(lib.mt_poll(self._raw_register, value))
        if word is not None:
            self.words([word])

    @staticmethod
    def _seen(receiver: MtReceiver | FirmwareReceiver) -> tuple[MtStatus, int, int, int]:
        return receiver.status, receiver.generation, receiver.checksum, receiver.digest


def run_receivers(data: bytes) -> None:
    """Feed DATA: axle, room, then records of two bytes; whatever it was, the next transmission arrives."""
    if len(data) < 2:
        return
    axle, room = AXLES[data[0] % len(AXLES)], len(LAST) + data[1] % (ROOM_MAX - len(LAST))
    pair = Pair(axle, room, (1 << 32) - 2 * GAP)
    at = 2
    while at + 1 < len(data):
        kind, value = data[at], data[at + 1]
        at += 2
        match kind & 3:
            case 0:
                length = value % 12
                pair.bytes(data[at : at + length])
                at += length
            case 1:
                pair.pause(value)
            case 2:
                pair.poll(_word(kind, value))
            case _:
                pair.words([_word(kind, value)])
    pair.words(transmission(LAST, [axle]))
    assert pair.python.pairs == LAST
    assert pair.python.status is MtStatus.OK


def _word(kind: int, value: int) -> int:
    word = SHORT[(kind >> 2) % len(SHORT)]
    return word if word in SHORT[:2] else (word + value % 32) & 0xFFFFFFFF
