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
    """Takes what a client sends, and returns its messages one by one, those that may stop the machine first.

    To take something costs nothing but its bytes: a client has as many messages read as it has turns for.
    """

    def __init__(self) -> None:
        self._rest = bytearray()
        self._scanned = 0
        """No end of a message before this."""
        self._searched = 0
        """No urgent word begins before this."""
        self._overtaken = 0
        """Bytes that an urgent message came behind."""

    def feed(self, data: bytes | memoryview) -> None:
        """Take DATA."""
        self._rest += data

    @property
    def has_message(self) -> bool:
        """Whether a message is complete."""
        return self._rest.find(END, self._scanned) >= 0

    def next_urgent(self) -> bytes | None:
        """Return the next message that may stop the machine; None: none is complete. Raises TooLongError."""
        at = self._find_urgent()
        end = -1 if at is None else self._rest.find(END, at)
        if end < 0:
            return None
        begin = self._rest.rfind(END, 0, at) + 1
        self._check_length(end - begin)
        body = bytes(self._rest[begin:end])
        del self._rest[begin : end + 1]
        self._searched = self._overtaken = begin
        self._scanned = min(self._scanned, begin)
        return body

    def next_message(self) -> tuple[bytes, bool] | None:
        """Return the next message in order, but for empty ones, and whether an urgent one came behind it.

        None: none is complete. Raises TooLongError.
        """
        self._drop(len(self._rest) - len(self._rest.lstrip(END)) if self._rest[:1] == END else 0)
        end = self._rest.find(END, self._scanned)
        self._check_length(len(self._rest) if end < 0 else end)
        if end < 0:
            self._scanned = len(self._rest)
            return None
        message = bytes(self._rest[:end]), self._overtaken > 0
        self._drop(end + 1)
        return message

    def messages(self, unread: bytes) -> list[bytes]:
        """Return all complete ones that wait here and in UNREAD; takes nothing. In any thread."""
        return (bytes(self._rest) + unread).split(END)[:-1]

    def _find_urgent(self) -> int | None:
        if self._rest.find(END, self._searched) < 0:
            return None  # there may be a word, but its message is not complete
        capitals = self._rest[self._searched :].upper()
        found = [at for word in URGENT if (at := capitals.find(word)) >= 0]
        if not found:
            self._searched = max(self._searched, len(self._rest) - max(map(len, URGENT)) + 1)
            return None
        self._searched += min(found)
        return self._searched

    def _drop(self, count: int) -> None:
        """Forget the first COUNT bytes."""
        if count:
            del self._rest[:count]
            self._scanned = 0
            self._searched = max(0, self._searched - count)
            self._overtaken = max(0, self._overtaken - count)

    def _check_length(self, length: int) -> None:
        if length > MESSAGE_BYTES_MAX:
            self._drop(len(self._rest))
            raise TooLongError(f"a message has more than {MESSAGE_BYTES_MAX:,} bytes")


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
