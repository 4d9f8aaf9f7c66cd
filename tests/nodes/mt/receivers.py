"""The receivers under test behind one face: Python's and the firmware's."""

from collections.abc import Iterable
from typing import Any, Protocol

from nodes.mt.mt import MtStatus, Pair
from nodes.virtual._sim import ffi, lib
from tests.nodes.mt.receiver import MtReceiver


class Receiver(Protocol):
    """What both have."""

    @property
    def status(self) -> MtStatus: ...
    @property
    def pairs(self) -> tuple[Pair, ...]: ...
    @property
    def generation(self) -> int: ...
    @property
    def checksum(self) -> int: ...
    @property
    def digest(self) -> int: ...

    def word(self, word: int) -> bool: ...


class FirmwareReceiver:
    """The receiver in C."""

    def __init__(self, axle: int, capacity: int) -> None:
        self._buffers = [ffi.new("struct mt_pair[]", max(capacity, 1)) for _ in range(2)]
        self.axle = axle
        self.raw: Any = ffi.new("struct mt_receiver *")
        lib.mt_start(self.raw, axle, *self._buffers, capacity)

    @property
    def status(self) -> MtStatus:
        return MtStatus(self.raw.status)

    @property
    def pairs(self) -> tuple[Pair, ...]:
        return tuple((self.raw.table[i].x, self.raw.table[i].y) for i in range(self.raw.length))

    @property
    def generation(self) -> int:
        return int(self.raw.generation)

    @property
    def checksum(self) -> int:
        return int(self.raw.checksum)

    @property
    def digest(self) -> int:
        return int(self.raw.digest)

    def word(self, word: int) -> bool:
        return bool(lib.mt_word(self.raw, word))


BOTH: tuple[type[MtReceiver] | type[FirmwareReceiver], ...] = (MtReceiver, FirmwareReceiver)


def feed(receiver: Receiver, words: Iterable[int]) -> int:
    """Give RECEIVER all WORDS; returns how many tables it kept."""
    return sum(receiver.word(word) for word in words)
