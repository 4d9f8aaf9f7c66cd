"""What a decoder makes of frames: one thing that was said on the bus, with its text made when asked for."""

import json
import re
from collections.abc import Mapping, Sequence
from enum import Enum
from typing import Final, NamedTuple, Protocol

from canbus_tools.protocol.protocol import Direction, FrameFormat
from nodes.dictionary.dictionary import Dictionary
from nodes.dictionary.message_format import MessageFormat, Value
from nodes.dictionary.parts import Enumeration, OutputFormat

_WORD: Final = re.compile(r"[\w.+/:-]+\Z")


class Kind(Enum):
    """What was said."""

    MESSAGE = "message"
    """One command to a node, or a response from it."""
    ACK = "ack"
    """An empty block from a node: it took what came before."""
    NAK = "nak"
    """An empty block from a node: what is under way has to be sent again."""
    ADMIN = "admin"
    SIGNAL = "signal"
    NOISE = "noise"
    """Bytes that make no block: frames lost, or bytes damaged."""
    ERROR = "error"
    """A report of the adapter."""
    OTHER = "other"
    """A frame of another protocol."""

    __hash__ = object.__hash__  # as of Direction


class Shape(Protocol):
    """Names and text of values."""

    @property
    def name(self) -> str:
        """What it is called."""

    @property
    def names(self) -> Sequence[str]:
        """Of its values."""

    def text(self, values: Sequence[Value]) -> str:
        """Return it as a line."""


class Decoded(NamedTuple):
    """One thing that was said on the bus; a tuple, because there are thousands in a second."""

    time_s: float
    """Of the last frame it needed."""
    channel: str
    nodeid: int | None
    """None: not about one node."""
    direction: Direction
    kind: Kind
    seq: int
    """The block's number modulo 16; from a node, the number it expects next. -1: no block."""
    repeated: bool
    """The host sent this block before."""
    shape: Shape
    values: Sequence[Value]

    @property
    def name(self) -> str:
        """The name of the message or frame."""
        return self.shape.name

    @property
    def params(self) -> Mapping[str, Value]:
        """Its parameters by name."""
        return dict(zip(self.shape.names, self.values, strict=True))

    @property
    def text(self) -> str:
        """What it says, as ``name parameter=value …`` with names for enumerated values."""
        return self.shape.text(self.values)


# ----------------------------------------------------------------------------------------------------- shapes


class MessageShape:
    """Text of one message of one dictionary: all that does not depend on the values is made once."""

    def __init__(self, format_: MessageFormat, dictionary: Dictionary) -> None:
        self.name = format_.name
        self.names = format_.names
        self.read = format_.read_values
        self._template = " ".join((format_.name, *(f"{name}=%s" for name in format_.names)))
        special: list[tuple[int, Enumeration | None]] = []
        for i, (name, code) in enumerate(zip(format_.names, format_.code_texts, strict=True)):
            enumeration = dictionary.enumeration_for(name)
            if code.endswith("s"):
                special.append((i, None))
            elif enumeration is not None:
                special.append((i, enumeration))
        self._special = tuple(special)

    def text(self, values: Sequence[Value]) -> str:
        """Return the text; buffers as hex digits, enumerated values by name."""
        if not self._special:
            return self._template % tuple(values)
        words: list[object] = [*values]
        for i, enumeration in self._special:
            value = words[i]
            if isinstance(value, bytes):
                words[i] = value.hex()
            elif enumeration is not None and isinstance(value, int):
                words[i] = quoted(enumeration.name_of(value)) or value
        return self._template % tuple(words)


def quoted(name: str | None) -> str | None:
    """Show a name as one word; what a terminal would obey is escaped."""
    return name if name is None or _WORD.match(name) else json.dumps(name)


class OutputShape:
    """Text of a debug output of the firmware."""

    names = ("text",)

    def __init__(self, format_: OutputFormat) -> None:
        self.name = format_.format.name
        self._format = format_

    def read(self, content: bytes, start: int) -> tuple[Sequence[Value], int] | None:
        """Decode it to its finished text, as UTF-8."""
        decoded = self._format.decode(content, start)
        return None if decoded is None else ((decoded[0].data("text"),), decoded[1])

    def text(self, values: Sequence[Value]) -> str:
        """Return the name and the text, with what a terminal would obey escaped."""
        raw = values[0] if isinstance(values[0], bytes) else b""
        said = raw.decode(errors="backslashreplace")
        return f"{self.name} {said if said.isprintable() else ascii(said)}"


class FrameShape:
    """Text of an admin or signal frame."""

    def __init__(self, format_: FrameFormat) -> None:
        self.name = format_.name
        self.names = tuple(f.name for f in format_.fields)
        self._fields = format_.fields
        self._start = format_.fields_at

    def read(self, data: bytes) -> Sequence[Value]:
        """Return the values of the fields; DATA is long enough."""
        values: list[Value] = []
        at = self._start
        for field in self._fields:
            values.append(field.read(data, at))
            at += field.size
        return values

    def text(self, values: Sequence[Value]) -> str:
        """Return the name with the fields."""
        words = (f"{f.name}={f.text(v)}" for f, v in zip(self._fields, values, strict=True))
        return " ".join((self.name, *words))


class PlainShape:
    """Text with a value or two at fixed places; bytes are shown as hex digits."""

    def __init__(self, name: str, names: Sequence[str], template: str) -> None:
        self.name = name
        self.names = tuple(names)
        self._template = template

    def text(self, values: Sequence[Value]) -> str:
        """Fill in the template."""
        return self._template % (*(v.hex(" ") if isinstance(v, bytes) else v for v in values),)


ACK = PlainShape("ack", ("next",), "ack next=%d")
NAK = PlainShape("nak", ("next",), "nak next=%d")
EMPTY = PlainShape("empty_block", (), "empty_block")
NOISE = PlainShape("noise", ("size", "data"), "%d bytes make no block: %s")
UNKNOWN = PlainShape("unknown", ("content",), "unknown content=%s")
OTHER = PlainShape("frame", ("id", "data"), "frame id=0x%03x data=%s")
OTHER_EXTENDED = PlainShape("frame_extended", ("id", "data"), "frame_extended id=0x%08x data=%s")
OTHER_REMOTE = PlainShape("frame_remote", ("id", "data"), "frame_remote id=0x%03x data=%s")
OTHER_FD = PlainShape("frame_fd", ("id", "data"), "frame_fd id=0x%03x data=%s")
