"""Commands of a recording decoded so that encoding them restores the same bytes.

Hosts send a clock in its 64-bit form, of which 35 bits reach the wire, and -1 as ``7f`` or as 2^32-1 in five
bytes: numbers that a node reads as the same 32 bits are distinguished here.
"""

from collections.abc import Iterable

from nodes.dictionary.dictionary import Dictionary
from nodes.dictionary.message_format import CODES, Message, MessageFormat, Value, vlq, vlq_read

FIVE_BYTES = 5
HIGH_GROUP_SHIFT = 4  # bits 28..31 are the low half of a five-byte number's first group
BITS32 = 0xFFFFFFFF


def decode_as_sent(dictionary: Dictionary, content: bytes) -> list[Message] | None:
    """Decode all commands of a block; None when any of them is unknown or cut short."""
    messages: list[Message] = []
    at = 0
    while at < len(content):
        found = dictionary.command_at(content, at)
        decoded = _decode(found[0], content, found[1]) if found else None
        if decoded is None:
            return None
        messages.append(decoded[0])
        at = decoded[1]
    return messages


def encode_as_sent(dictionary: Dictionary, messages: Iterable[Message]) -> bytes:
    """Encode what ``decode_as_sent`` returned."""
    return b"".join(_encode(dictionary.command(message.name), message) for message in messages)


def _decode(command: MessageFormat, data: bytes, start: int) -> tuple[Message, int] | None:
    values: list[Value] = []
    at = start
    for code in command.codes:
        number = vlq_read(data, at)
        if number is None:
            return None
        value, behind = number
        if code.wire_type == CODES["%s"].wire_type:
            if value > len(data) - behind:
                return None
            values.append(data[behind : behind + value])
            at = behind + value
            continue
        values.append(_number(value, data[at:behind]))
        at = behind
    return Message(command.name, dict(zip(command.names, values, strict=True))), at


def _encode(command: MessageFormat, message: Message) -> bytes:
    out = command.prefix
    for value in message.params.values():
        out += vlq(len(value)) + value if isinstance(value, bytes) else _vlq(value)
    return out


def _number(value: int, encoded: bytes) -> int:
    if len(encoded) < FIVE_BYTES:
        return value - (1 << 32) if value >> 31 else value
    return value | (encoded[0] & 0x7F) >> HIGH_GROUP_SHIFT << 32


def _vlq(value: int) -> bytes:
    if value <= BITS32:
        return vlq(value)
    low = vlq(value & BITS32 | 1 << 31)  # five bytes whatever the low bits are
    first = low[0] & ~0x0F | value >> 28 & 0x0F | value >> 32 << HIGH_GROUP_SHIFT
    return bytes((first,)) + low[1:]
