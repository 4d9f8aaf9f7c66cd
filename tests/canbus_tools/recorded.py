"""The recorded session of a real node, as it would have been on a CAN bus."""

import ast
import re
import struct
from pathlib import Path

import pytest

from canbus_tools.protocol.frame import Frame
from canbus_tools.protocol.protocol import Direction, data_id

SHARED = Path(__file__).parents[2] / ".." / "shared" / "data"
RECORD = struct.Struct("<dBI")
DIRECTIONS = {0: Direction.TO_NODE, 1: Direction.FROM_NODE}
LINE = re.compile(r"([\d.]+) (H>M|M>H) len=\d+ seq: ([0-9a-f]{2}) \| (.*) \| ([0-9a-f]+)\Z")
PARAM = re.compile(r"""(\w+)=(b'(?:[^'\\]|\\.)*'|b"(?:[^"\\]|\\.)*"|\S+)""")
NODEID = 4


def session(name: str) -> Path:
    path = SHARED / "wire" / name
    if not path.exists():
        pytest.skip("no recorded session of a real node in ../shared")
    return path


def frames(nodeid: int = NODEID, size: int = 8, start_s: float = 1000.0) -> list[Frame]:
    """Cut each piece of the recording into frames of SIZE bytes."""
    record, at = session("pipe.rec").read_bytes(), 0
    found: list[Frame] = []
    while at < len(record):
        time_s, direction, length = RECORD.unpack_from(record, at)
        at += RECORD.size
        can_id = data_id(nodeid, DIRECTIONS[direction])
        for begin in range(at, at + length, size):
            piece = record[begin : min(begin + size, at + length)]
            found.append(Frame(start_s + time_s, can_id, piece))
        at += length
    return found


def value(text: str) -> int | bytes | str:
    """Return a number, a buffer, or the name of an enumerated value."""
    if text[0].isalpha() and text[1] not in "'\"":
        return text
    read: int | bytes = ast.literal_eval(text)
    return read & 0xFFFFFFFF if isinstance(read, int) else read


def messages() -> list[tuple[Direction, int, str, dict[str, int | bytes | str]]]:
    """Return direction, sequence, name and parameters of all messages that the session's text has."""
    found = []
    for line in session("pipe.txt").read_text().splitlines():
        match = LINE.match(line)
        assert match, line
        direction = Direction.TO_NODE if match[2] == "H>M" else Direction.FROM_NODE
        for said in match[4].split(" ; ") if direction is Direction.TO_NODE else [match[4]]:
            name, _, rest = said.partition(" ")
            params = {p[1]: value(p[2]) for p in PARAM.finditer(rest)}
            found.append((direction, int(match[3], 16) & 15, name, params))
    return found
