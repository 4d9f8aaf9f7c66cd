"""A second reader of a WebSocket's frames, for the stop lane, and what bounds their number; sans-IO.

RFC 6455, as far as browsers use it.
"""

import struct
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

FRAMES_PER_TURN: Final = 8
"""The server needs about 25 µs for one, whatever it carries."""
FRAMES_PER_S: Final = 200
"""Small ones of one browser, on average; the page sends a few for each click."""
FRAMES_MAX: Final = 600
"""Small ones at once."""
SMALL_BYTES: Final = 1_024
"""A frame of as many, as files come in, costs less than its bytes do."""

_FINAL: Final = 0x80
_OPCODE: Final = 0x0F
_CONTINUATION: Final = 0x00
_MESSAGES: Final = (0x01, 0x02)
"""Opcodes of text and binary."""
_CONTROL: Final = 0x08
_MASKED: Final = 0x80
_LENGTH_16: Final = 126
_LENGTH_64: Final = 127
_MASK_BYTES: Final = 4


class UnrelayedMessages:
    """The messages that a browser has sent and nobody has looked at.

    The server's reader puts them into a queue where the stop lane does not see them, so they are read here as
    well: ``feed`` gets what comes, ``relayed`` is called for each message that was looked at. What no browser
    sends ends it, and a message of more than BYTES_MAX does: with those the server ends the connection.
    """

    def __init__(self, bytes_max: int) -> None:
        self._bytes_max = bytes_max
        self._rest = bytearray()
        """Of a frame that is not there as a whole."""
        self._begun: bytearray | None = None
        """Of a message whose last frame is not there."""
        self._waiting: deque[bytes] = deque()
        self._over = False

    def feed(self, data: bytes) -> None:
        """Take DATA, which has come."""
        if self._over:
            return
        self._rest += data
        try:
            while self._take_frame():
                pass
        except ValueError:
            self.end()

    @property
    def is_empty(self) -> bool:
        """Whether no message waits."""
        return not self._waiting

    def relayed(self) -> None:
        """Forget the oldest message."""
        if self._waiting:
            self._waiting.popleft()
        else:  # the server has read something else
            self.end()

    def lines(self, unread: bytes) -> bytes:
        """Return the messages that wait and those in UNREAD, which comes next, as lines; in any thread.

        Of frames that are more than a browser may send at once, the first ones count.
        """
        twin = UnrelayedMessages(self._bytes_max)
        twin._rest, twin._over = self._rest.copy(), self._over
        twin._begun = None if self._begun is None else self._begun.copy()
        twin._waiting = self._waiting.copy()
        if not twin._over:
            twin._rest += unread
        try:
            for _ in range(FRAMES_MAX):
                if not twin._take_frame():
                    break
        except ValueError:
            twin.end()
        return b"".join(message + b"\n" for message in twin._waiting)

    def _take_frame(self) -> bool:
        """Take the frame that is next, and return whether there was one; raises ValueError."""
        frame = _first_frame(self._rest, self._bytes_max)
        if frame is None:
            return False
        if not frame.first & _CONTROL:
            self._take(frame)
        del self._rest[: frame.size]
        return True

    def _take(self, frame: "_Frame") -> None:
        begins = frame.first & _OPCODE != _CONTINUATION
        if begins is (self._begun is not None):
            raise ValueError("a message begins within another, or goes on without a beginning")
        self._begun = bytearray() if self._begun is None else self._begun
        self._begun += frame.body
        if len(self._begun) > self._bytes_max:
            raise ValueError("the message is too long")
        if frame.first & _FINAL:
            self._waiting.append(bytes(self._begun))
            self._begun = None

    def end(self) -> None:
        """Forget all, and what is to come: nobody will look at it."""
        self._over, self._begun = True, None
        self._rest.clear()
        self._waiting.clear()


class FrameIntake:
    """Lets few frames of a browser through at a time, to MESSAGES and to the server.

    The next ones come when the messages in them were relayed. More small frames than FRAMES_PER_S end it,
    with one call of ON_FLOOD; times are NOW_S's.
    """

    def __init__(
        self, messages: UnrelayedMessages, now_s: Callable[[], float], on_flood: Callable[[], None]
    ) -> None:
        self._messages = messages
        self._now_s = now_s
        self._on_flood = on_flood
        self._left_bytes = 0
        """Of the frame that was let through in part."""
        self._free = float(FRAMES_MAX)
        """Small frames that may come at once."""
        self._counted_s = now_s()
        self._ended = False

    @property
    def is_busy(self) -> bool:
        """Whether nothing may be let through before messages were relayed."""
        return self._ended or not self._messages.is_empty

    def take(self, waiting: bytearray) -> bytes:
        """Take from WAITING and return what may be let through; nothing of a header that is incomplete."""
        size, frames = 0, 0
        while size < len(waiting):
            if self._left_bytes == 0:
                frame_bytes = _frame_bytes(waiting, size)
                if frame_bytes is None or frames == FRAMES_PER_TURN:
                    break
                frames += 1
                self._left_bytes = frame_bytes
                if not self._may_come(frame_bytes):
                    self._end(waiting)
                    return b""
            part_bytes = min(self._left_bytes, len(waiting) - size)
            self._left_bytes -= part_bytes
            size += part_bytes
        data = bytes(waiting[:size])
        self._messages.feed(data)
        del waiting[:size]  # behind that: the stop lane finds it here or there
        return data

    def _may_come(self, frame_bytes: int) -> bool:
        """Count a frame of FRAME_BYTES; return whether there were not too many."""
        if frame_bytes >= SMALL_BYTES:
            return True
        now_s = self._now_s()
        self._free = min(FRAMES_MAX, self._free + (now_s - self._counted_s) * FRAMES_PER_S) - 1
        self._counted_s = now_s
        return self._free >= 0

    def _end(self, waiting: bytearray) -> None:
        self._ended = True
        waiting.clear()
        self._messages.end()
        self._on_flood()


@dataclass(frozen=True, slots=True)
class _Frame:
    first: int
    """Byte: whether it is the last of its message, and its opcode."""
    body: bytes
    size: int
    """With its header, bytes."""


def _first_frame(data: bytearray, bytes_max: int) -> _Frame | None:
    """Return the frame that DATA begins with; None: it is not there as a whole.

    Raises ValueError for what browsers do not send, and for more than BYTES_MAX.
    """
    if len(data) < 2:
        return None
    first = data[0]
    known = first & _CONTROL or first & ~_FINAL in (_CONTINUATION, *_MESSAGES)
    if not known or not data[1] & _MASKED:
        raise ValueError("it is no frame of a browser")
    header = _read_header(data, 0)
    if header is None:
        return None
    at, length = header
    if length > bytes_max:
        raise ValueError("the frame is too long")
    end = at + _MASK_BYTES + length
    if len(data) < end:
        return None
    mask = (bytes(data[at : at + _MASK_BYTES]) * (length // _MASK_BYTES + 1))[:length]
    body = int.from_bytes(data[at + _MASK_BYTES : end]) ^ int.from_bytes(mask)
    return _Frame(first, body.to_bytes(length), end)


def _read_header(data: bytearray, at: int) -> tuple[int, int] | None:
    """Return where the header of the frame at AT ends, but for its mask, and its length; None: not there."""
    if len(data) < at + 2:
        return None
    length = data[at + 1] & ~_MASKED
    if length < _LENGTH_16:
        return at + 2, length
    end = at + (4 if length == _LENGTH_16 else 10)
    if len(data) < end:
        return None
    (length,) = struct.unpack_from(">H" if length == _LENGTH_16 else ">Q", data, at + 2)
    return end, length


def _frame_bytes(data: bytearray, at: int) -> int | None:
    """Return the size of the frame that begins AT, with its header; None: its length is not there."""
    header = _read_header(data, at)
    if header is None:
        return None
    end, length = header
    return end - at + (_MASK_BYTES if data[at + 1] & _MASKED else 0) + length
