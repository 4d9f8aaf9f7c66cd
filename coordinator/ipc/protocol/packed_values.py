"""Counts the values of a msgpack message without making them: a list costs a byte to send, and 50 to hold."""

from typing import Final

_FIRST_OF_TABLE: Final = 0xC0
_TABLE: Final = (
    *[(0, 0, 0)] * 4,  # nil, (never used), false, true
    *[(0, 1, 0), (0, 2, 0), (0, 4, 0)],  # bytes
    *[(1, 1, 0), (1, 2, 0), (1, 4, 0)],  # extensions, with a byte for their type
    *[(4, 0, 0), (8, 0, 0)],  # floats
    *[(1, 0, 0), (2, 0, 0), (4, 0, 0), (8, 0, 0)] * 2,  # integers without and with sign
    *[(2, 0, 0), (3, 0, 0), (5, 0, 0), (9, 0, 0), (17, 0, 0)],  # extensions of fixed size
    *[(0, 1, 0), (0, 2, 0), (0, 4, 0)],  # strings
    *[(0, 2, 1), (0, 4, 1)],  # lists
    *[(0, 2, 2), (0, 4, 2)],  # maps
)
"""For the first bytes 0xC0 to 0xDF: bytes to skip; bytes of the length behind them; values for each of that
length, 0 where it is one of bytes."""


def has_more_values(body: bytes, most: int) -> bool:
    """Tell whether BODY has more than MOST values, keys and the message itself included; looks at no more.

    Of what is no msgpack any answer is right.
    """
    if len(body) <= most:
        return False
    at, due, seen, end = 0, 1, 0, len(body)
    while due and at < end:
        seen += 1
        if seen > most:
            return True
        due -= 1
        first = body[at]
        at += 1
        if first < 0x80 or first >= 0xE0:
            continue  # a small number
        if first < 0xA0:
            due += (first & 15) * (2 if first < 0x90 else 1)
        elif first < _FIRST_OF_TABLE:
            at += first & 31
        else:
            skipped, head, values = _TABLE[first - _FIRST_OF_TABLE]
            length = int.from_bytes(body[at : at + head])
            at += skipped + head + (0 if values else length)
            due += values * length
    return False
