"""Messages on a stream of bytes: msgpack behind a length, or JSON lines; sans-IO.

The first byte decides: ``{`` begins a line of JSON. A msgpack message begins with its length, 4 bytes, big
endian; lengths stay below 16 MiB, so its first byte is 0. Nothing that comes in raises: what cannot be a
message ends in one ``Fault``, after which the stream is dead.
"""

import json
import math
import struct
from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum
from typing import Any, Final

import msgpack

from coordinator.ipc.protocol.json_values import has_more_items
from coordinator.ipc.protocol.packed_values import has_more_values
from coordinator.ipc.server.settings import Limits
from coordinator.support.values import Value

LENGTH: Final = struct.Struct(">I")
LENGTH_MAX: Final = 2**24 - 1
"""Keeps the first byte of every msgpack message 0."""
_BRACE: Final = ord("{")


class Encoding(Enum):
    """How messages are written."""

    MSGPACK = "msgpack"
    JSON = "json"


@dataclass(frozen=True, slots=True)
class Fault:
    """Why a stream ends: CODE for programs, SENTENCE for people."""

    code: str
    sentence: str


class Encoder:
    """Writes messages; one for many streams of the same thread. What UTF-8 cannot write becomes ``?``."""

    def __init__(self) -> None:
        self._packer = msgpack.Packer(buf_size=65_536, unicode_errors="replace")
        self._dumps = json.JSONEncoder(allow_nan=False, ensure_ascii=False, separators=(",", ":")).encode

    def message(self, encoding: Encoding, message: Mapping[str, Value]) -> bytes:
        """Return MESSAGE as bytes; raises ValueError when it is too long, or holds what none can carry."""
        if encoding is Encoding.JSON:
            return self._json(message) + b"\n"
        body = self._pack(message)
        return _with_length(body)

    def entries(self, encoding: Encoding, part: Mapping[str, Value]) -> bytes:
        """Return the entries of PART, a piece for ``joined``; raises ValueError as ``message`` does."""
        if encoding is Encoding.JSON:
            return self._json(part)[1:-1]
        pack = self._pack
        return b"".join(pack(key) + pack(value) for key, value in part.items())

    def joined(self, encoding: Encoding, count: int, first: bytes, second: bytes) -> bytes:
        """Return one message of COUNT (at most 15) entries, FIRST's and SECOND's."""
        if encoding is Encoding.JSON:
            return b"{%b,%b}\n" % (first, second)
        return _with_length(b"%c%b%b" % (0x80 | count, first, second))

    def _pack(self, value: object) -> bytes:
        try:
            return bytes(self._packer.pack(value))
        except (TypeError, OverflowError) as error:
            raise ValueError(str(error)) from None

    def _json(self, value: object) -> bytes:
        try:
            return self._dumps(value).encode(errors="replace")
        except (TypeError, RecursionError) as error:
            raise ValueError(str(error)) from None


def _with_length(body: bytes) -> bytes:
    if len(body) > LENGTH_MAX:
        raise ValueError(f"the message has {len(body):,} bytes, {LENGTH_MAX:,} at most")
    return LENGTH.pack(len(body)) + body


class WireReader:
    """Takes the bytes of one stream and gives its messages, as maps; times in seconds of one clock.

    CHECKED: messages hold only what every language can carry, within the limits; else only their bytes count.
    """

    def __init__(self, limits: Limits, *, checked: bool = True) -> None:
        self._checked = checked
        self.encoding: Encoding | None = None
        self.messages = 0
        self._limits = limits
        self._buffer = bytearray()
        self._scanned = 0  # no line end before this
        self._fed_s = 0.0
        self._begun_s: float | None = None  # since when a message is incomplete
        self._fault: Fault | None = None

    def feed(self, data: bytes | memoryview, now_s: float) -> None:
        """Take DATA that has arrived."""
        self._fed_s = now_s
        if self._fault is None:
            self._buffer += data

    @property
    def waiting_bytes(self) -> int:
        """Bytes fed and not yet given as messages."""
        return len(self._buffer)

    def next_message(self) -> dict[str, Any] | Fault | None:
        """Return the next message, None until there are more bytes, or why there will be none."""
        if self._fault is not None:
            return self._fault
        body = self._next_body()
        if isinstance(body, Fault):
            return self._die(body)
        if body is None:
            if self._buffer and self._begun_s is None:
                self._begun_s = self._fed_s
            return None
        self._begun_s = None
        self.messages += 1
        message = self._decode(body)
        if isinstance(message, Fault):
            return self._die(message)
        if not isinstance(message, dict):
            return self._die(Fault("bad_message", "a message must be a map"))
        flaw = _Inspection(self._limits).flaw(message, self._limits.nesting) if self._checked else None
        return message if flaw is None else self._die(flaw)

    def next_deadline(self) -> float | None:
        """Return until when the message that has begun must be complete."""
        return None if self._begun_s is None else self._begun_s + self._limits.message_timeout_s

    def handle_timer(self, now_s: float) -> Fault | None:
        """Return the fault when a message has been incomplete for too long."""
        deadline_s = self.next_deadline()
        if deadline_s is None or now_s < deadline_s:
            return None
        wait = f"{self._limits.message_timeout_s:g} s"
        return self._die(Fault("timeout", f"a message was not complete {wait} after its first byte"))

    def _die(self, fault: Fault) -> Fault:
        self._fault = fault
        self._begun_s = None
        self._buffer.clear()
        return fault

    # ---------------------------------------------------------------------------------------- framing

    def _next_body(self) -> bytes | Fault | None:
        if not self._buffer:
            return None
        if self.encoding is None:
            first = self._buffer[0]
            if first not in (0, _BRACE):
                return Fault(
                    "bad_message",
                    f"the first byte is 0x{first:02x}; begin with a length (msgpack) or '{{' (JSON lines)",
                )
            self.encoding = Encoding.JSON if first == _BRACE else Encoding.MSGPACK
        return self._next_line() if self.encoding is Encoding.JSON else self._next_packed()

    def _next_packed(self) -> bytes | Fault | None:
        buffer = self._buffer
        if len(buffer) < LENGTH.size:
            return None
        (length,) = LENGTH.unpack_from(buffer)
        if length > self._limits.message_bytes:
            return self._too_long(f"{length:,} bytes")
        end = LENGTH.size + length
        if len(buffer) < end:
            return None
        body = bytes(buffer[LENGTH.size : end])
        del buffer[:end]
        return body

    def _next_line(self) -> bytes | Fault | None:
        buffer, limit = self._buffer, self._limits.message_bytes
        while (end := buffer.find(b"\n", self._scanned)) >= 0:
            if end > limit:
                return self._too_long(f"{end:,} bytes")
            line = bytes(buffer[:end]).strip()
            del buffer[: end + 1]
            self._scanned = 0
            if line:
                return line
        self._scanned = len(buffer)
        return self._too_long(f"more than {limit:,} bytes") if len(buffer) > limit else None

    def _too_long(self, length: str) -> Fault:
        limit = self._limits.message_bytes
        return Fault("too_long", f"a message of {length} is too long; {limit:,} bytes at most")

    # ---------------------------------------------------------------------------------------- content

    def _decode(self, body: bytes) -> object:
        try:
            return self._from_json(body) if self.encoding is Encoding.JSON else self._from_msgpack(body)
        except (RecursionError, msgpack.StackError):
            return _too_deep(self._limits)
        except UnicodeDecodeError:
            return Fault("bad_message", "a message has text that is no UTF-8")

    def _from_json(self, body: bytes) -> object:
        if self._checked and has_more_items(body, self._limits.values):
            return _too_many(self._limits)
        text = body.decode()
        try:
            return json.loads(text, parse_constant=_refuse_constant)
        except _ConstantError as error:
            return Fault("bad_message", f"{error} is no number of JSON; numbers are finite")
        except json.JSONDecodeError as error:
            return Fault("bad_message", f"a message is no JSON: {error.msg}, at character {error.pos + 1}")
        except ValueError:  # of int()
            return Fault("bad_message", "a whole number has too many digits")

    def _from_msgpack(self, body: bytes) -> object:
        items, values = self._limits.items, self._limits.values
        if self._checked and has_more_values(body, 2 * values + 1):  # keys count here, too
            return _too_many(self._limits)
        try:
            return msgpack.unpackb(body, max_array_len=items, max_map_len=items, max_ext_len=0)
        except (UnicodeDecodeError, msgpack.StackError):
            raise
        except (ValueError, msgpack.UnpackException):
            return Fault("bad_message", f"a message is no msgpack, or has lists of more than {items:,} items")


def _too_many(limits: Limits) -> Fault:
    return Fault("too_long", f"the lists and maps of a message have more than {limits.values:,} items")


def _too_deep(limits: Limits) -> Fault:
    return Fault("too_deep", f"a message is nested more than {limits.nesting} deep")


class _ConstantError(ValueError):
    """NaN, Infinity or -Infinity."""


def _refuse_constant(word: str) -> None:
    raise _ConstantError(word)


_PLAIN: Final = (int, bool, type(None))


class _Inspection:
    """Looks for what a message must not hold."""

    def __init__(self, limits: Limits) -> None:
        self._limits = limits
        self._values_left = limits.values

    def flaw(self, value: Any, depth: int) -> Fault | None:
        """Return what VALUE must not hold, at most DEPTH lists and maps down; None if all is well."""
        kind = type(value)
        if kind is dict or kind is list:
            return self._flaw_within(value, depth)
        if kind is str:
            sound = value.isascii() or _is_text(value)
            return None if sound else Fault("bad_message", "a string is no Unicode")
        if kind is float:
            return None if math.isfinite(value) else Fault("bad_message", "a number is not finite")
        if kind in _PLAIN:
            return None
        return Fault("bad_message", "a message holds what JSON has no type for; text is a string, not bytes")

    def _flaw_within(self, value: Any, depth: int) -> Fault | None:  # noqa: PLR0911 (one for each flaw)
        limits = self._limits
        if depth == 0:
            return _too_deep(limits)
        if len(value) > limits.items:
            return Fault("too_long", f"a list or map has more than {limits.items:,} items")
        self._values_left -= len(value)
        if self._values_left < 0:
            return _too_many(limits)
        if type(value) is dict:
            for key in value:
                if type(key) is not str:
                    return Fault("bad_message", "the keys of maps must be strings")
                if not (key.isascii() or _is_text(key)):
                    return Fault("bad_message", "a string is no Unicode")
            value = value.values()
        for below in value:
            if type(below) not in _PLAIN and (found := self.flaw(below, depth - 1)) is not None:
                return found
        return None


def _is_text(value: str) -> bool:
    """Tell text from strings with half of a surrogate pair, which JSON can write and UTF-8 cannot."""
    try:
        value.encode()
    except UnicodeEncodeError:
        return False
    return True
