"""A slow, obvious twin of the wire protocol, written from its description: the oracle of these tests."""

import json
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any

Value = int | bytes


def vlq(value: int) -> bytes:
    """Encode -2^31 .. 2^32-1."""
    groups = 1
    while groups < 5 and not -(32 * 128 ** (groups - 1)) <= value < 96 * 128 ** (groups - 1):
        groups += 1
    digits = [(value >> (7 * k)) & 0x7F for k in reversed(range(groups))]
    return bytes(digit | 0x80 for digit in digits[:-1]) + bytes(digits[-1:])


def unvlq(data: bytes, at: int) -> tuple[int, int]:
    """Decode to a signed number; return it and the place behind it."""
    value = data[at] & 0x7F
    if value & 0x60 == 0x60:
        value -= 0x80
    while data[at] & 0x80:
        at += 1
        value = value * 128 + (data[at] & 0x7F)
    return value, at + 1


def crc16(data: bytes) -> int:
    crc = 0xFFFF
    for byte in data:
        crc ^= byte
        for _ in range(8):
            crc = crc >> 1 ^ (0x8408 if crc & 1 else 0)
    return crc


def block(seq: int, content: bytes = b"") -> bytes:
    body = bytes([len(content) + 5, 0x10 | seq & 15]) + content
    return body + crc16(body).to_bytes(2, "big") + b"\x7e"


def blocks(stream: bytes) -> Iterator[tuple[int, bytes]]:
    """Split a flawless stream into (seq, content); asserts that it is flawless."""
    while stream:
        length = stream[0]
        one, stream = stream[:length], stream[length:]
        assert len(one) == length >= 5, one
        assert one[-1] == 0x7E
        assert crc16(one[:-3]) == int.from_bytes(one[-3:-1], "big")
        assert one[1] & 0xF0 == 0x10
        yield one[1] & 15, one[2:-3]


@dataclass(frozen=True)
class Answer:
    name: str
    args: dict[str, Value]
    seq: int

    def __getitem__(self, key: str) -> int:
        value = self.args[key]
        assert isinstance(value, int)
        return value


@dataclass
class Vocabulary:
    """The formats of one dictionary."""

    raw: dict[str, Any] = field(
        default_factory=lambda: {
            "commands": {"identify offset=%u count=%c": 1},
            "responses": {"identify_response offset=%u data=%.*s": 0},
        }
    )

    def encode(self, text: str) -> bytes:
        """Encode "name a=1 b=-2 data=00ff"."""
        name, *words = text.split()
        given = dict(word.split("=", 1) for word in words)
        for fmt, number in self.raw["commands"].items():
            if fmt.split()[0] != name:
                continue
            out = vlq(number)
            for parameter in fmt.split()[1:]:
                key, _, code = parameter.partition("=")
                value = given.pop(key)
                if code.endswith("s"):
                    data = bytes.fromhex(value)
                    out += vlq(len(data)) + data
                else:
                    out += vlq(int(value))
            assert not given, given
            return out
        raise AssertionError(name)

    def decode(self, seq: int, content: bytes) -> Answer:
        number, at = unvlq(content, 0)
        for fmt, known in self.raw["responses"].items():
            if known != number:
                continue
            name, *parameters = fmt.split()
            args: dict[str, Value] = {}
            for parameter in parameters:
                key, _, code = parameter.partition("=")
                value, at = unvlq(content, at)
                if code.endswith("s"):
                    args[key], at = content[at : at + value], at + value
                else:
                    args[key] = value if code in {"%i", "%hi"} else value & 0xFFFFFFFF
            assert at == len(content)
            return Answer(name, args, seq)
        raise AssertionError(f"no response has the id {number}")


def download(ask: Callable[[str], Answer]) -> tuple[dict[str, Any], bytes]:
    """Fetch a dictionary; return it and its compressed bytes."""
    blob = b""
    while True:
        answer = ask(f"identify offset={len(blob)} count=40")
        data = answer.args["data"]
        assert answer["offset"] == len(blob)
        assert isinstance(data, bytes)
        if not data:
            return json.loads(zlib.decompress(blob)), blob
        blob += data
