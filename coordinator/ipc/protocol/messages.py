"""Messages on a stream of bytes: msgpack behind a length, or JSON lines; sans-IO.

The first byte decides: ``{`` begins a line of JSON. A msgpack message begins with its length, 4 bytes, big
endian; lengths stay below 16 MiB, so its first byte is 0. Nothing that comes in raises: what cannot be a
message ends in one ``EndReason``, after which the stream is dead.
"""

import json
import struct
from collections.abc import Iterable, Mapping
from enum import Enum
from typing import Any, Final

import msgpack

from coordinator.ipc.protocol.decoding import RejectedError, check_values, decode_json, decode_msgpack
from coordinator.ipc.protocol.limits import EndReason, Limits
from coordinator.support.values import Value

LENGTH: Final = struct.Struct(">I")
LENGTH_MAX: Final = 2**24 - 1
"""Keeps the first byte of every msgpack message 0."""
_BRACE: Final = ord("{")


class Encoding(Enum):
    """How messages are written."""

    MSGPACK = "msgpack"
    JSON = "json"


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
    """Takes the bytes of one stream and returns its messages, as maps; times in seconds of one clock.

    CHECKED: messages hold only what every language can carry, within the limits; else only their bytes count.
    """

    def __init__(self, limits: Limits, *, checked: bool = True) -> None:
        self._checked = checked
        self.encoding: Encoding | None = None
        self.message_bytes_max = limits.message_bytes
        """Bytes of one message, without its length or line end."""
        self._limits = limits
        self._buffer = bytearray()
        self._scanned = 0  # no line end before this
        self._fed_s = 0.0
        self._begun_s: float | None = None  # since when a message is incomplete
        self._end_reason: EndReason | None = None

    def copy(self) -> "WireReader":
        """Return a reader that has what this one has and goes on by itself; from any thread."""
        twin = WireReader(self._limits, checked=self._checked)
        twin.encoding, twin.message_bytes_max = self.encoding, self.message_bytes_max
        twin._buffer = self._buffer[:]
        return twin

    def feed(self, data: bytes | memoryview, now_s: float) -> None:
        """Take DATA that has arrived."""
        self._fed_s = now_s
        if self._end_reason is None:
            self._buffer += data

    @property
    def waiting_bytes(self) -> int:
        """Bytes fed and not yet returned as messages."""
        return len(self._buffer)

    def find(self, words: Iterable[bytes], since: int = 0) -> int:
        """Return where in what waits the first of WORDS is that ends behind byte SINCE; -1: there is none."""
        found = (self._buffer.find(word, max(0, since - len(word) + 1)) for word in words)
        return min((at for at in found if at >= 0), default=-1)

    def skip_to(self, at: int) -> None:
        """Drop the messages that end before byte AT of what waits."""
        begin = 0
        if self.encoding is Encoding.JSON:
            begin = self._buffer.rfind(b"\n", 0, at) + 1
        while self.encoding is Encoding.MSGPACK and begin + LENGTH.size <= at:
            end = begin + LENGTH.size + LENGTH.unpack_from(self._buffer, begin)[0]
            if end > at:
                break
            begin = end
        if begin:
            del self._buffer[:begin]
            self._scanned = 0
            self._begun_s = None

    def next_message(self) -> dict[str, Any] | EndReason | None:
        """Return the next message, None until there are more bytes, or why there will be none."""
        if self._end_reason is not None:
            return self._end_reason
        try:
            body = self._next_body()
            if body is not None:
                self._begun_s = None
                return self._decode(body)
        except RejectedError as error:
            return self._end(error.end)
        if self._buffer and self._begun_s is None:
            self._begun_s = self._fed_s
        return None

    def next_deadline(self) -> float | None:
        """Return until when the message that has begun must be complete."""
        return None if self._begun_s is None else self._begun_s + self._limits.message_timeout_s

    def handle_timer(self, now_s: float) -> EndReason | None:
        """End the stream, and return why, when a message has been incomplete for too long."""
        deadline_s = self.next_deadline()
        if deadline_s is None or now_s < deadline_s:
            return None
        wait = f"{self._limits.message_timeout_s:g} s"
        return self._end(EndReason("timeout", f"a message was not complete {wait} after its first byte"))

    def _end(self, reason: EndReason) -> EndReason:
        self._end_reason = reason
        self._begun_s = None
        self._buffer.clear()
        return reason

    def _decode(self, body: bytes) -> dict[str, Any]:
        if self.encoding is Encoding.JSON:
            message = decode_json(body, self._limits)
        else:
            message = decode_msgpack(body, self._limits, checked=self._checked)
        if not isinstance(message, dict):
            raise RejectedError("bad_message", "a message must be a map")
        if self._checked:
            check_values(message, self._limits)
        return message

    # ---------------------------------------------------------------------------------------- framing

    def _next_body(self) -> bytes | None:
        if not self._buffer:
            return None
        if self.encoding is None:
            first = self._buffer[0]
            if first not in (0, _BRACE):
                raise RejectedError(
                    "bad_message",
                    f"the first byte is 0x{first:02x}; begin with a length (msgpack) or '{{' (JSON lines)",
                )
            self.encoding = Encoding.JSON if first == _BRACE else Encoding.MSGPACK
        return self._next_line() if self.encoding is Encoding.JSON else self._next_packed()

    def _next_packed(self) -> bytes | None:
        buffer = self._buffer
        if len(buffer) < LENGTH.size:
            return None
        (length,) = LENGTH.unpack_from(buffer)
        if length > self.message_bytes_max:
            raise self._too_long(f"{length:,} bytes")
        end = LENGTH.size + length
        if len(buffer) < end:
            return None
        body = bytes(buffer[LENGTH.size : end])
        del buffer[:end]
        return body

    def _next_line(self) -> bytes | None:
        buffer, limit = self._buffer, self.message_bytes_max
        while (end := buffer.find(b"\n", self._scanned)) >= 0:
            if end > limit:
                raise self._too_long(f"{end:,} bytes")
            line = bytes(buffer[:end]).strip()
            # Empty lines go all together: however many there are, they cost no turn of the loop.
            del buffer[: end + 1 if line else len(buffer) - len(buffer.lstrip())]
            self._scanned = 0
            if line:
                return line
        self._scanned = len(buffer)
        if len(buffer) > limit:
            raise self._too_long(f"more than {limit:,} bytes")
        return None

    def _too_long(self, length: str) -> RejectedError:
        limit = self.message_bytes_max
        return RejectedError("too_long", f"a message of {length} is too long; {limit:,} bytes at most")
