"""Messages between the program and the process that renders templates (worker.py).

To the worker go pickles: it believes what the program says. What comes from it is JSON, plain text and
numbers, each with a bound: a template that broke out of its sandbox could send anything.
"""

import io
import json
import pickle
import socket
import struct
from array import array
from collections.abc import Callable, Mapping
from enum import Enum
from typing import Any, Final

from coordinator.gcode.place import Place

_REQUEST: Final = struct.Struct("<I")
_ANSWER: Final = struct.Struct("<III")
"""Bytes of an answer's JSON, of the rendered text, and of its line numbers."""
HEADER_SIZE: Final = _ANSWER.size
JSON_BYTES_MAX: Final = 8_388_608
TEXT_BYTES_MAX: Final = 4_194_304
LINES_BYTES_MAX: Final = 4_194_304
_CHUNK: Final = 65_536


class BadAnswer(Exception):  # noqa: N818 (a sentence of the caller's follows)
    """What the worker sent is no answer."""


class _Pickler(pickle.Pickler):
    """Writes plain values as they are, and everything else as the plain value that comes closest."""

    def reducer_override(self, obj: object) -> Any:
        if obj is Place or type(obj) is Place:
            return NotImplemented
        if isinstance(obj, Enum):
            return _same, (obj.value,)
        if isinstance(obj, Mapping):
            return dict, (list(obj.items()),)
        if isinstance(obj, tuple | list):
            return (tuple if isinstance(obj, tuple) else list), (list(obj),)
        if obj in _FUNCTIONS:
            return NotImplemented
        return str, (str(obj),)


def _same(value: object) -> object:
    return value


_FUNCTIONS: Final = (_same, dict, tuple, list, str)


def encode_request(request: tuple[object, ...]) -> bytes:
    """Return REQUEST for the worker; raises RecursionError when a value is nested too deeply."""
    out = io.BytesIO()
    _Pickler(out, pickle.HIGHEST_PROTOCOL).dump(request)
    return _REQUEST.pack(out.tell()) + out.getvalue()


def read_request(channel: socket.socket) -> tuple[Any, ...] | None:
    """Return the next request; None: the program has ended."""
    head = _read(channel, _REQUEST.size)
    body = None if head is None else _read(channel, _REQUEST.unpack(head)[0])
    return None if body is None else pickle.loads(body)  # noqa: S301 (of the program that started us)


def _read(channel: socket.socket, size: int) -> bytes | None:
    data = bytearray()
    while len(data) < size:
        chunk = channel.recv(min(size - len(data), _CHUNK))
        if not chunk:
            return None
        data += chunk
    return bytes(data)


def encode_answer(answer: Mapping[str, object], text: str = "", lines: "array[int] | None" = None) -> bytes:
    """Return ANSWER with a rendered TEXT and the template's line for each of its LINES."""
    head = json.dumps(answer, ensure_ascii=False).encode("utf-8", "surrogatepass")
    body = text.encode("utf-8", "surrogatepass")
    numbers = b"" if lines is None else lines.tobytes()
    return _ANSWER.pack(len(head), len(body), len(numbers)) + head + body + numbers


def read_answer(read: Callable[[int], bytes]) -> tuple[dict[str, Any], str, tuple[int, ...]]:
    """Return the answer, text and line numbers that READ brings; raises BadAnswer."""
    sizes = _ANSWER.unpack(read(HEADER_SIZE))
    if any(
        size > most
        for size, most in zip(sizes, (JSON_BYTES_MAX, TEXT_BYTES_MAX, LINES_BYTES_MAX), strict=True)
    ):
        raise BadAnswer("it makes more than fits into a program")
    head, body, numbers = (read(size) for size in sizes)
    lines = array("I")
    try:
        answer = json.loads(head.decode("utf-8", "surrogatepass"))
        text = body.decode("utf-8", "surrogatepass")
        lines.frombytes(numbers)
    except (ValueError, RecursionError):
        raise BadAnswer("its result cannot be read") from None
    if not isinstance(answer, dict):
        raise BadAnswer("its result cannot be read")
    return answer, text, tuple(lines)
