"""One message of a node's vocabulary: its format, and its encoding and decoding by the C codec.

Every encoding and decoding is one call into ``firmware/wire``. A format reuses the buffers that it passes to
C, so it must be used from one thread only (the control loop's).
"""

import re
import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

from nodes.support._wire import ffi, lib
from nodes.support.errors import CanductorError

Value = int | bytes
"""What a parameter carries: a number, or the raw bytes of a buffer."""

CONTENT_MAX: Final[int] = lib.WIRE_CONTENT_MAX
"""Bytes of content one block can carry, hence the longest message."""
MAX_PARAMETERS: Final = 16
"""Of one message; real ones have up to 9."""
NAME: Final = re.compile(r"[A-Za-z_][A-Za-z0-9_]*\Z")
_BITS32: Final = 0xFFFFFFFF
_ALL: Final = -1
"""All bits of a number, whatever its sign."""
_BYTES: Final[int] = lib.WIRE_BYTES


class MessageError(CanductorError):
    """A message cannot be encoded: unknown name, wrong parameters, or a value its parameter cannot hold."""


@dataclass(frozen=True, slots=True)
class Message:
    """A decoded message: its name and its parameters by name, in the order of the format.

    Numbers have the signedness of the parameter's code. ``str()`` gives the text that
    ``Dictionary.encode_text`` takes.
    """

    name: str
    params: dict[str, Value]

    def integer(self, param: str) -> int:
        """Return the number PARAM; raises KeyError for a buffer or a missing parameter."""
        value = self.params[param]
        if isinstance(value, int):
            return value
        raise KeyError(f"{self.name} {param} is a buffer")

    def data(self, param: str) -> bytes:
        """Return the bytes of buffer PARAM; raises KeyError for a number or a missing parameter."""
        value = self.params[param]
        if isinstance(value, bytes):
            return value
        raise KeyError(f"{self.name} {param} is a number")

    def __str__(self) -> str:
        words = (f"{name}={v.hex() if isinstance(v, bytes) else v}" for name, v in self.params.items())
        return " ".join((self.name, *words))


@dataclass(frozen=True, slots=True)
class Code:
    """Meaning of a parameter's code: the C codec's type and the range of numbers.

    The code states the size; the reader chooses the signedness: an unsigned parameter also takes negative
    numbers of its size (``invert_step=%c`` is -1 for steps on both edges).
    """

    wire_type: int
    low: int
    high: int
    field: str
    """The struct module's letter for the number's signedness in C's 32 bits."""


CODES: Final[Mapping[str, Code]] = {
    "%u": Code(lib.WIRE_U32, -(1 << 31), (1 << 32) - 1, "I"),
    "%i": Code(lib.WIRE_I32, -(1 << 31), (1 << 31) - 1, "i"),
    "%hu": Code(lib.WIRE_U16, -(1 << 15), (1 << 16) - 1, "I"),
    "%hi": Code(lib.WIRE_I16, -(1 << 15), (1 << 15) - 1, "i"),
    "%c": Code(lib.WIRE_U8, -(1 << 7), (1 << 8) - 1, "I"),
    "%s": Code(lib.WIRE_BYTES, 0, 0, "I"),
    "%*s": Code(lib.WIRE_BYTES, 0, 0, "I"),
    "%.*s": Code(lib.WIRE_BYTES, 0, 0, "I"),
}

# struct wire_arg as the struct module sees it: the number, and the address behind its padding.
_DATA_AT: Final[int] = ffi.offsetof("struct wire_arg", "data")
_POINTER_SIZE: Final[int] = ffi.sizeof("uint8_t *")
_POINTER: Final = f"{_DATA_AT - 4}x{'Q' if struct.calcsize('=Q') == _POINTER_SIZE else 'I'}"


# Looked up once: used for every message.
_pack: Final = lib.wire_pack
_read: Final = lib.message_values


class MessageFormat:
    """A message's name, id and parameters, able to encode and decode it.

    NAMES and CODES_ are its parameters in order, checked by the caller. MESSAGE_ID: -2^31..2^31-1.
    """

    def __init__(self, name: str, message_id: int, names: Sequence[str], codes: Sequence[str]) -> None:
        self.name = name
        self.message_id = message_id
        self.names = tuple(names)
        self._known = frozenset(names)
        self.codes = tuple(CODES[code] for code in codes)
        self._fields = tuple(
            (name, code.wire_type == _BYTES, code.low, code.high, _ALL if code.field == "i" else _BITS32)
            for name, code in zip(self.names, self.codes, strict=True)
        )
        """Of each parameter the name, whether it is a buffer, the range, and the bits that C gets."""
        self.code_texts = tuple(codes)
        self._count = len(self.names)
        self._types = ffi.new("uint8_t[]", bytes(code.wire_type for code in self.codes) or b"\0")
        self._args = ffi.new("struct wire_arg[]", max(1, len(names)))
        self._args_view = memoryview(ffi.buffer(self._args))
        self._read = ffi.new("struct message_value[]", max(1, len(names)))
        self._read_view = memoryview(ffi.buffer(self._read))
        self._numbers = struct.Struct("=" + "".join(f"{code.field}4x" for code in self.codes))
        """Of a ``struct message_value`` each."""
        self._pairs = struct.Struct("=" + "".join(code.field + _POINTER for code in self.codes))
        self._buffers = tuple(i for i, code in enumerate(self.codes) if code.wire_type == lib.WIRE_BYTES)
        self.prefix = vlq(message_id)
        self._start = len(self.prefix)
        self._out = ffi.new("uint8_t[]", CONTENT_MAX)
        self._content = memoryview(ffi.buffer(self._out))
        self._content[: self._start] = self.prefix
        self._out_args = self._out + self._start

    def __repr__(self) -> str:
        return f"MessageFormat({self.text!r}, {self.message_id})"

    @property
    def text(self) -> str:
        """The format in the notation of dictionaries."""
        pairs = zip(self.names, self.code_texts, strict=True)
        return " ".join((self.name, *(f"{name}={code}" for name, code in pairs)))

    # ---------------------------------------------------------------------------------------------- encode

    def encode(self, values: Mapping[str, Value | str]) -> bytes:
        """Encode the message, id included; MessageError when VALUES do not fit it, as no text does."""
        if len(values) != self._count or not self._known.issuperset(values):
            raise MessageError(self._mismatch(values))
        if not self._count:
            return self.prefix
        pairs: list[int] = []
        keep: list[object] = []  # what the addresses point into
        for name, is_buffer, low, high, bits in self._fields:
            value = values[name]
            if is_buffer:
                pairs += self._buffer(name, value, keep)
            elif isinstance(value, int) and low <= value <= high:
                pairs += (value & bits, 0)
            else:
                raise MessageError(self._unfit(name, value, low, high))
        self._pairs.pack_into(self._args_view, 0, *pairs)
        used: int = _pack(self._types, self._count, self._args, self._out_args, CONTENT_MAX - self._start)
        if not used:
            raise MessageError(
                f"{self.name}: longer than the {CONTENT_MAX} bytes one block carries; send less at once"
            )
        return self._content[: self._start + used].tobytes()

    def _buffer(self, name: str, value: Value | str, keep: list[object]) -> tuple[int, int]:
        if not isinstance(value, bytes):
            raise MessageError(f"{self.name}: {name} takes bytes, not {value!r}")
        held = ffi.from_buffer("uint8_t[]", value)
        keep.append(held)
        return len(value), int(ffi.cast("uintptr_t", held))

    def _unfit(self, name: str, value: Value | str, low: int, high: int) -> str:
        if not isinstance(value, int):
            return f"{self.name}: {name} takes a number, not {value!r}"
        return f"{self.name}: {name}={value} is outside {low}..{high}"

    def _mismatch(self, values: Mapping[str, Value | str]) -> str:
        missing = [name for name in self.names if name not in values]
        unknown = [name for name in values if name not in self.names]
        faults = [
            f"{what} {' '.join(names)}"
            for what, names in (("missing", missing), ("unknown", unknown))
            if names
        ]
        return f"{self.name}: {', '.join(faults)}; the node's firmware has '{self.text}'"

    # ---------------------------------------------------------------------------------------------- decode

    def decode(self, content: bytes, start: int) -> tuple[Message, int] | None:
        """Decode the parameters at START of CONTENT.

        Return the message and the offset of its end, or None when it is cut short.
        """
        found = self.read_values(content, start)
        if found is None:
            return None
        return Message(self.name, dict(zip(self.names, found[0], strict=True))), found[1]

    def read_values(self, content: bytes, start: int) -> tuple[Sequence[Value], int] | None:
        """Decode like ``decode``, but return only the parameters' values, in the order of ``names``."""
        if not self._count:
            return (), start
        end: int = _read(self._types, self._count, content, len(content), start, self._read)
        if not end:
            return None
        values: Sequence[Value] = self._numbers.unpack_from(self._read_view)
        if self._buffers:
            values = list(values)
            for i in self._buffers:
                at = self._read[i].at
                values[i] = content[at : at + values[i]]
        return values, end


def vlq(value: int) -> bytes:
    """Encode one number (-2^31..2^32-1) in the form of its sign."""
    out = ffi.new("uint8_t[]", lib.WIRE_VLQ_MAX)
    return bytes(ffi.buffer(out, lib.wire_vlq_encode(out, value)))


def vlq_read(data: bytes, start: int) -> tuple[int, int] | None:
    """Return the number at START of DATA as unsigned 32 bits and its end; None when it is cut short."""
    held = ffi.from_buffer("uint8_t[]", data)
    cursor = ffi.new("const uint8_t *[1]", [held + start])
    value = ffi.new("uint32_t *")
    if lib.wire_vlq_decode(cursor, held + len(data), value):
        return None
    return value[0], cursor[0] - held
