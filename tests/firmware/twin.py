"""What a node understands and says, from its dictionary and the slow twin of the wire protocol."""

import json
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any

from tests import wire_twin
from tests.wire_twin import read_vlq, vlq_encode

Value = int | bytes


def blocks(stream: bytes) -> Iterator[tuple[int, bytes]]:
    """Split a flawless stream into (seq, content); asserts that it is flawless."""
    found, losses, rest = wire_twin.blocks(stream)
    assert not losses
    assert not rest
    for one in found:
        yield one.sequence, one.content


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
            out = vlq_encode(number)
            for parameter in fmt.split()[1:]:
                key, _, code = parameter.partition("=")
                value = given.pop(key)
                if code.endswith("s"):
                    data = bytes.fromhex(value)
                    out += vlq_encode(len(data)) + data
                else:
                    out += vlq_encode(int(value))
            assert not given, given
            return out
        raise AssertionError(name)

    def decode(self, seq: int, content: bytes) -> Answer:
        number, at = read_vlq(content, 0)
        for fmt, known in self.raw["responses"].items():
            if known != number:
                continue
            name, *parameters = fmt.split()
            args: dict[str, Value] = {}
            for parameter in parameters:
                key, _, code = parameter.partition("=")
                value, at = read_vlq(content, at)
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
