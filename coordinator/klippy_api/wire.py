"""Messages of the API: JSON objects in UTF-8, each ended by the byte 0x03; no I/O.

A message that cannot be understood is dropped without an answer; one that is too long ends its connection.
"""

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final

from coordinator.ipc.protocol.decoding import RejectedError, check_values, decode_json
from coordinator.ipc.protocol.limits import Limits
from nodes.support.errors import CanductorError
from nodes.support.terminal import printable_lines

END: Final = b"\x03"
MESSAGE_BYTES_MAX: Final = 262_144
"""One message of a client, without its end."""
LIMITS: Final = Limits(nesting=64, items=8_192)
INTEGER_BITS_MAX: Final = 64
"""Of a number in a message that cannot be written as it is; longer ones go out as null."""
URGENT: Final = (b"EMERGENCY_STOP", b"M112")
"""A message with one of these words, in capitals or not, overtakes all others that wait."""


class TooLongError(CanductorError):
    """A client sends a message that nobody would read."""


class UnwritableError(CanductorError):
    """A message that JSON cannot carry."""


class UnreadableError(CanductorError):
    """A message that is dropped; the text says why."""


@dataclass(frozen=True, slots=True)
class Request:
    """One call of a client."""

    method: str
    params: Mapping[str, Any]
    id: Any = None
    """Of any JSON type; None: no answer is wanted."""
    overtaken: bool = False
    """An urgent one came behind it, and was done first."""


class Framer:
    """Cuts what a client sends into messages; keeps at most MESSAGE_BYTES_MAX and one piece."""

    def __init__(self) -> None:
        self._rest = bytearray()
        self._scanned = 0

    def copy(self) -> "Framer":
        """Return one that has what this one has and goes on by itself; from any thread."""
        twin = Framer()
        twin._rest = self._rest[:]
        return twin

    def feed(self, data: bytes | memoryview) -> list[bytes]:
        """Return the messages that DATA completes; raises TooLongError."""
        self._rest += data
        found: list[bytes] = []
        begin = 0
        while (end := self._rest.find(END, max(begin, self._scanned))) >= 0:
            found.append(bytes(self._rest[begin:end]))
            begin = end + 1
        del self._rest[:begin]
        self._scanned = len(self._rest)
        if self._scanned > MESSAGE_BYTES_MAX or any(len(body) > MESSAGE_BYTES_MAX for body in found):
            self._rest.clear()
            self._scanned = 0
            raise TooLongError(f"a message has more than {MESSAGE_BYTES_MAX:,} bytes")
        return found


def is_urgent(body: bytes) -> bool:
    """Return whether BODY may be a call that stops the machine."""
    capitals = body.upper()
    return any(word in capitals for word in URGENT)


def read_request(body: bytes, *, overtaken: bool = False) -> Request:
    """Return the call in BODY; raises UnreadableError."""
    try:
        message = decode_json(body, LIMITS)
        check_values(message, LIMITS)
    except RejectedError as error:
        raise UnreadableError(str(error)) from None
    if not isinstance(message, dict):
        raise UnreadableError("a message is not an object")
    method, params = message.get("method"), message.get("params", {})
    if not isinstance(method, str):
        raise UnreadableError("a message has no method")
    if not isinstance(params, dict):
        raise UnreadableError("the params of a message are not an object")
    return Request(method, params, message.get("id"), overtaken)


def encode(message: Mapping[str, Any]) -> bytes:
    """Return MESSAGE as it is sent; numbers that JSON does not have go out as null, other things as text.

    Raises UnwritableError.
    """
    try:
        try:
            text = _dumps(message)
        except ValueError:
            text = _dumps(_finite(message))
    except (TypeError, ValueError, RecursionError) as error:
        raise UnwritableError(f"the message cannot be written as JSON: {error}") from None
    return text.encode(errors="replace") + END


def _dumps(message: object) -> str:
    return json.dumps(message, separators=(",", ":"), allow_nan=False, default=str)


def result_message(request_id: Any, result: Mapping[str, Any]) -> bytes:
    """Return the answer to the call with REQUEST_ID."""
    return encode({"id": request_id, "result": result})


def error_message(request_id: Any, sentence: str) -> bytes:
    """Return the answer to a call that failed."""
    return encode(
        {"id": request_id, "error": {"error": "WebRequestError", "message": printable_lines(sentence)}}
    )


def event_message(template: Mapping[str, Any], params: Mapping[str, Any]) -> bytes:
    """Return what a client gets without a call: its TEMPLATE with PARAMS."""
    return encode({**template, "params": params})


def _finite(value: Any) -> Any:
    """Return VALUE with None for numbers that are not finite, or too long to be written."""
    if isinstance(value, float) and not math.isfinite(value):
        return None
    if isinstance(value, int) and value.bit_length() > INTEGER_BITS_MAX:
        return None
    if isinstance(value, Mapping):
        return {str(key): _finite(inner) for key, inner in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(inner) for inner in value]
    return value
