"""Extracts every valid block from the payloads of one data id, for listening tools.

After an error, a node discards bytes up to the next sync byte and so loses a valid block. A listening tool
need not: it tries every offset in the damaged bytes.
"""

from collections.abc import Sequence
from typing import Any, Final

from canbus_tools.protocol.decoded import Decoded
from canbus_tools.protocol.frame import Frame
from canbus_tools.protocol.traffic import DirectionTraffic
from nodes.support._wire import ffi, lib

GAP_S: Final = 0.1
"""A block whose bytes stop coming for so long was cut off if what comes then begins another one; hosts and
nodes give it up then anyway, but an onlooker's times are those of its own machine, which may have been busy.
"""
NOISE_SHOWN: Final = 64
"""Most bytes of noise in one report."""
_MIN: Final[int] = lib.WIRE_BLOCK_MIN
_MAX: Final[int] = lib.WIRE_BLOCK_MAX
_MARK: Final[int] = lib.WIRE_SEQ_MARK >> 4
_BLOCK: Final[int] = lib.WIRE_BLOCK
_MORE: Final[int] = lib.WIRE_MORE
_SYNC: Final = bytes((lib.WIRE_SYNC,))
_scan: Final = lib.wire_scan


def _begins_block(data: bytes) -> bool:
    return len(data) > 1 and _MIN <= data[0] <= _MAX and data[1] >> 4 == _MARK


class Noise(bytes):
    """Bytes that made no block."""


class BlockStream:
    """One direction's frames. Holds less than one block, and up to NOISE_SHOWN bytes of noise.

    ``feed`` runs for every frame of a bus: that is why it counts as well.
    """

    def __init__(self, way: DirectionTraffic) -> None:
        self._way = way
        self._noise = bytearray()  # not yet reported
        self._held = b""
        self._last = Frame(0.0, 0, b"")
        self._scanner: Any = ffi.new("struct wire_scanner *")
        self._skip = ffi.new("size_t *")
        self._length = ffi.new("size_t *")

    def feed(self, frame: Frame) -> Sequence[Decoded]:
        """Take the next frame; returns what it completed, usually nothing."""
        data = frame[2]
        way = self._way
        way.frames += 1
        way.bytes += len(data)
        held = self._held
        if held:
            if frame[0] - self._last[0] > GAP_S and _begins_block(data):
                return self._feed_behind_gap(frame)
            data = held + data
        self._last = frame
        if 1 < len(data) < data[0] <= _MAX and data[1] >> 4 == _MARK:
            self._held = data
            return ()
        found = self._cut(data, last=False)
        return self._take(found, frame) if found else ()

    def flush(self) -> Sequence[Decoded]:
        """Give up waiting: return what can be read of what is held."""
        found = self._cut(self._held, last=True)
        if self._noise:
            self._report_noise(found)
        return self._take(found, self._last)

    def _take(self, found: Sequence[bytes], frame: Frame) -> Sequence[Decoded]:
        """Make something of whole blocks and, where it stood between them, Noise; FRAME ended them."""
        raise NotImplementedError

    def _feed_behind_gap(self, frame: Frame) -> Sequence[Decoded]:
        given_up = self.flush()
        self._way.frames -= 1  # feed counts it again
        self._way.bytes -= len(frame.data)
        return [*given_up, *self.feed(frame)]

    def _cut(self, data: bytes, *, last: bool) -> list[bytes]:
        found: list[bytes] = []
        while data:
            outcome = _scan(self._scanner, data, len(data), self._skip, self._length)
            if outcome == _BLOCK:
                if self._noise:
                    self._report_noise(found)
                start = self._skip[0]
                end = start + self._length[0]
                found.append(data[start:end])
                data = data[end:]
                continue
            self._scanner.hunting = 0  # it would drop sound blocks in the damaged stretch
            data = data.lstrip(_SYNC)
            drop = 1
            if outcome == _MORE and not last:
                drop = self._sound_block_at(data) if self._noise else 0
                if not drop:
                    break
            self._drop(found, data[:drop])
            data = data[drop:]
        self._held = data
        return found

    def _drop(self, found: list[bytes], noise: bytes) -> None:
        self._noise += noise
        if len(self._noise) >= NOISE_SHOWN:
            self._report_noise(found)

    def _report_noise(self, found: list[bytes]) -> None:
        found.append(Noise(self._noise))
        self._noise.clear()

    def _sound_block_at(self, data: bytes) -> int:
        """Return where a sound block begins behind the first byte, 0: nowhere.

        After noise, the apparent start of a block may be noise too; then a complete block must not wait for
        the rest of it.
        """
        for at in range(1, len(data) - _MIN + 1):
            if data[at + 1] >> 4 != _MARK or not _MIN <= data[at] <= len(data) - at:
                continue
            outcome = _scan(self._scanner, data[at:], len(data) - at, self._skip, self._length)
            self._scanner.hunting = 0
            if outcome == _BLOCK:
                return at
        return 0
