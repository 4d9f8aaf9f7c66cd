"""Error frames: what an adapter reports of the bus, as linux/can/error.h lays it out."""

from collections.abc import Sequence
from typing import Final

from canbus_tools.protocol.decoded import PlainShape
from nodes.dictionary.message_format import Value

ERROR_FLAG: Final = 0x2000_0000
CLASSES: Final = {
    0x001: "transmit time-out",
    0x002: "arbitration lost",
    0x004: "controller problem",
    0x008: "protocol violation",
    0x010: "transceiver problem",
    0x020: "no acknowledgement: no other node receives this adapter's frames",
    0x040: "bus off: the adapter took itself off the bus",
    0x080: "bus error",
    0x100: "restarted after bus off",
    0x200: "error counters",
}
"""Bits of the id."""
CONTROLLER: Final = {
    0x01: "receive buffer overflow",
    0x02: "transmit buffer overflow",
    0x04: "many receive errors (warning)",
    0x08: "many transmit errors (warning)",
    0x10: "error passive by receive errors",
    0x20: "error passive by transmit errors",
    0x40: "error active again",
}
"""Bits of data[1], where the class is a controller problem."""
PROTOCOL: Final = {
    0x01: "a single bit",
    0x02: "frame format",
    0x04: "bit stuffing",
    0x08: "a dominant bit was not sent",
    0x10: "a recessive bit was not sent",
    0x20: "bus overload",
    0x40: "active error announcement",
    0x80: "while transmitting",
}
"""Bits of data[2], where the class is a protocol violation."""
_NAMES: Final = ("classes", "data")


def error_frame(can_id: int, data: bytes) -> tuple[PlainShape, Sequence[Value]]:
    """Return text and values of an error frame, whatever it holds."""
    bits = can_id & ~ERROR_FLAG
    words = [_words(word, bit, data) for bit, word in CLASSES.items() if bits & bit]
    said = "; ".join(words) or "no error class named"
    if len(data) == 8 and (data[6] or data[7]):
        said += f"; errors counted: {data[6]} transmit, {data[7]} receive"
    return PlainShape("error", _NAMES, f"error 0x%03x [%s] {said}"), (bits, data)


def _words(word: str, bit: int, data: bytes) -> str:
    at, names = {0x004: (1, CONTROLLER), 0x008: (2, PROTOCOL)}.get(bit, (0, {}))
    details = [name for mask, name in names.items() if len(data) > at and data[at] & mask]
    return f"{word} ({', '.join(details)})" if details else word
