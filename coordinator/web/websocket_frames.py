"""Reads WebSocket frames that a browser has sent and nobody has taken yet; RFC 6455, as far as that needs."""

import struct
from typing import Final

_TEXT: Final = 0x81
"""The first byte of a text message in one frame."""
_CONTROL: Final = 0x08
_MASKED: Final = 0x80
_LENGTH_16: Final = 126
_LENGTH_64: Final = 127
_MASK_BYTES: Final = 4


def lines_in(data: bytes) -> bytes:
    """Return the text messages in DATA as lines, up to the first thing that is no whole frame.

    DATA begins with a frame. Messages in several frames end it: browsers send short ones in one.
    """
    lines = bytearray()
    at = 0
    while len(data) >= at + 2:
        first, length = data[at], data[at + 1] & ~_MASKED
        if not data[at + 1] & _MASKED or not (first == _TEXT or first & _CONTROL):
            break
        at += 2
        if length >= _LENGTH_16:
            size = 2 if length == _LENGTH_16 else 8
            if len(data) < at + size:
                break
            (length,) = struct.unpack(">H" if length == _LENGTH_16 else ">Q", data[at : at + size])
            at += size
        end = at + _MASK_BYTES + length
        if len(data) < end:
            break
        if first == _TEXT:
            mask, body = data[at : at + _MASK_BYTES], data[at + _MASK_BYTES : end]
            key = (mask * (length // _MASK_BYTES + 1))[:length]
            lines += (int.from_bytes(body) ^ int.from_bytes(key)).to_bytes(length) + b"\n"
        at = end
    return bytes(lines)
