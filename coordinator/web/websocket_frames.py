"""A second reader of a WebSocket's frames, for the stop lane; RFC 6455, as far as browsers use it."""

import struct
from collections import deque
from dataclasses import dataclass
from typing import Final

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
            while (frame := _first_frame(self._rest, self._bytes_max)) is not None:
                self._take(frame)
                del self._rest[: frame.size]
        except ValueError:
            self._end()

    def relayed(self) -> None:
        """Forget the oldest message."""
        if self._waiting:
            self._waiting.popleft()
        else:  # the server has read something else
            self._end()

    def lines(self, unread: bytes) -> bytes:
        """Return the messages that wait and those in UNREAD, which comes next, as lines; in any thread."""
        twin = UnrelayedMessages(self._bytes_max)
        twin._rest, twin._over = self._rest.copy(), self._over
        twin._begun = None if self._begun is None else self._begun.copy()
        twin._waiting = self._waiting.copy()
        twin.feed(unread)
        return b"".join(message + b"\n" for message in twin._waiting)

    def _take(self, frame: "_Frame") -> None:
        if frame.first & _CONTROL:
            return
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

    def _end(self) -> None:
        self._over, self._begun = True, None
        self._rest.clear()
        self._waiting.clear()


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
    first, length = data[0], data[1] & ~_MASKED
    known = first & _CONTROL or first & ~_FINAL in (_CONTINUATION, *_MESSAGES)
    if not known or not data[1] & _MASKED:
        raise ValueError("it is no frame of a browser")
    at = 2
    if length >= _LENGTH_16:
        at = 4 if length == _LENGTH_16 else 10
        if len(data) < at:
            return None
        (length,) = struct.unpack(">H" if at == 4 else ">Q", data[2:at])
    if length > bytes_max:
        raise ValueError("the frame is too long")
    end = at + _MASK_BYTES + length
    if len(data) < end:
        return None
    mask = (bytes(data[at : at + _MASK_BYTES]) * (length // _MASK_BYTES + 1))[:length]
    body = int.from_bytes(data[at + _MASK_BYTES : end]) ^ int.from_bytes(mask)
    return _Frame(first, body.to_bytes(length), end)
