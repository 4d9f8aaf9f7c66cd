"""The data dictionary: a node's description of its own commands, responses, enumerations and constants.

A dictionary comes off a wire and is untrusted until parsed: every size is bounded, and every fault raises
DictionaryError with one sentence. Once parsed it does not change; decoding is total (a message or None).
"""

import re
import zlib
from collections.abc import Mapping
from typing import Final, TypeVar

from nodes.dictionary.constants import CONSTANTS
from nodes.dictionary.message_format import Message, MessageError, MessageFormat, Value, vlq_read
from nodes.dictionary.parts import (
    DictionaryError,
    Enumeration,
    OutputFormat,
    parse_enumerations,
    parse_formats,
)
from nodes.support.plain_json import read_json

MAX_INFLATED_BYTES: Final = 1 << 16
"""Real dictionaries have 8 to 13 kB. Here and in ``parts``: what the control loop has time to read."""
MAX_COMPRESSED_BYTES: Final = 1 << 15
"""Size at which a download is given up; real dictionaries have some 4 kB."""
IDENTIFY: Final = "identify offset=%u count=%c"
IDENTIFY_RESPONSE: Final = "identify_response offset=%u data=%.*s"
_WORD: Final = re.compile(r'\s*([A-Za-z_]\w*)=("(?:[^"\\]|\\.)*"|\S*)')
_HEX: Final = re.compile(r"(?:0x)?((?:[0-9a-fA-F]{2})*)\Z")
_INTEGER: Final = re.compile(r"[+-]?(?:0x[0-9a-fA-F]{1,16}|[0-9]{1,20})\Z")


class Dictionary:
    """The messages of one firmware build. Create it with ``parse`` or ``from_json``."""

    def __init__(self, source: Mapping[str, object]) -> None:
        self.version = _text(source, "version")
        self.build_versions = _text(source, "build_versions")
        self.app = _text(source, "app")
        self.license = _text(source, "license")
        self.constants: Mapping[str, int | float | str] = _constants(source)
        self.enumerations: Mapping[str, Enumeration] = parse_enumerations(source.get("enumerations", {}))
        taken: dict[int, str] = {}
        self.commands = parse_formats(source, "commands", taken, {"identify": (IDENTIFY, 1)})
        self.responses = parse_formats(
            source, "responses", taken, {"identify_response": (IDENTIFY_RESPONSE, 0)}
        )
        self.outputs = OutputFormat.parse_all(source.get("output", {}), taken)
        self._commands_by_id = {f.message_id: f for f in self.commands.values()}
        self._commands_by_prefix = {f.prefix: f for f in self.commands.values()}
        self._responses_by_id: dict[int, MessageFormat | OutputFormat] = {
            f.message_id: f for f in self.responses.values()
        }
        self._responses_by_id.update({output.message_id: output for output in self.outputs})
        self._by_prefix = {f.prefix: f for f in self._responses_by_id.values()}

    # ----------------------------------------------------------------------------------------------- parse

    @classmethod
    def parse(cls, compressed: bytes) -> "Dictionary":
        """Parse a downloaded (zlib-compressed) dictionary; raises DictionaryError."""
        if len(compressed) > MAX_COMPRESSED_BYTES:
            raise DictionaryError(f"dictionary: more than {MAX_COMPRESSED_BYTES} bytes compressed; refused")
        inflater = zlib.decompressobj()
        try:
            inflated = inflater.decompress(compressed, MAX_INFLATED_BYTES + 1)
        except zlib.error as error:
            raise DictionaryError(
                f"dictionary: not zlib data ({error}); other firmware, or the download was damaged"
            ) from None
        if len(inflated) > MAX_INFLATED_BYTES:
            raise DictionaryError(f"dictionary: inflates to more than {MAX_INFLATED_BYTES} bytes; refused")
        if not inflater.eof:
            raise DictionaryError("dictionary: the compressed data ends early; the download was cut short")
        return cls.from_json(inflated)

    @classmethod
    def from_json(cls, text: bytes) -> "Dictionary":
        """Parse an inflated dictionary; raises DictionaryError."""
        if len(text) > MAX_INFLATED_BYTES:
            raise DictionaryError(f"dictionary: has more than {MAX_INFLATED_BYTES} bytes; refused")
        try:
            source = read_json(text, _unique)
        except ValueError as error:
            raise DictionaryError(f"dictionary: not usable JSON ({error})") from None
        if not isinstance(source, dict):
            raise DictionaryError("dictionary: not a JSON object")
        return cls(source)

    # -------------------------------------------------------------------------------------------- look up

    def command(self, name: str) -> MessageFormat:
        """Return the command NAME; MessageError when the firmware has none of that name."""
        if name in self.commands:
            return self.commands[name]
        raise MessageError(f"the node's firmware ({self.version}) has no command {name!r}")

    def int_constant(self, name: str, default: int | None = None) -> int:
        """Return an integer constant of CONSTANTS, or DEFAULT where the dictionary has none.

        DictionaryError when there is neither, or it is out of its range.
        """
        value = self.constants.get(name)
        if value is None and default is not None:
            return default
        low, high = CONSTANTS[name]
        if isinstance(value, int) and low <= value <= high:
            return value
        found = "missing" if value is None else f"{value!r:.60}"
        raise DictionaryError(
            f"dictionary: constant {name} must be a whole number of {low}..{high} and is {found}; "
            "flash the firmware again, or report this to its makers"
        )

    def check_constants(self) -> None:
        """Raise DictionaryError for a constant of CONSTANTS that is out of its range, or no CLOCK_FREQ."""
        for name in CONSTANTS:
            if name in self.constants or name == "CLOCK_FREQ":
                self.int_constant(name)

    def str_constant(self, name: str, default: str | None = None) -> str:
        """Return a text constant, or DEFAULT; DictionaryError when there is neither."""
        value = self.constants.get(name, default)
        if isinstance(value, str):
            return value
        found = "missing" if value is None else f"{value!r}"
        raise DictionaryError(f"dictionary: constant {name} must be a text and is {found}")

    @property
    def clock_freq_hz(self) -> int:
        """Nominal ticks per second, > 0."""
        return self.int_constant("CLOCK_FREQ")

    @property
    def receive_window(self) -> int:
        """Bytes that may be in flight to the node (192 unless the dictionary says so)."""
        return self.int_constant("RECEIVE_WINDOW", 192)

    def enumeration_for(self, param: str) -> Enumeration | None:
        """Return the enumeration of parameter PARAM: named like it or like the part after an underscore."""
        while param:
            if param in self.enumerations:
                return self.enumerations[param]
            _, _, param = param.partition("_")
        return None

    def enum_name(self, enumeration: str, value: int) -> str:
        """Return the name of VALUE, or ``?VALUE`` when the enumeration does not know it."""
        known = self.enumerations.get(enumeration)
        return (known and known.name_of(value)) or f"?{value}"

    # --------------------------------------------------------------------------------------------- encode

    def encode(self, name: str, /, **values: Value | str) -> bytes:
        """Encode command NAME; a text as VALUE is a name of the parameter's enumeration. MessageError."""
        return encode_values(self, self.command(name), values)

    def encode_text(self, text: str) -> bytes:
        """Encode a command written as ``name parameter=value …``; MessageError.

        Values are numbers (decimal or 0x…), names of the parameter's enumeration, and for buffers hex digits
        or a text in double quotes.
        """
        name, _, rest = text.strip().partition(" ")
        command = self.command(name)
        values: dict[str, Value | str] = {}
        at = 0
        while rest[at:].strip():
            word = _WORD.match(rest, at)
            if word is None:
                raise MessageError(f"{name}: {rest[at:].strip()!r} is not parameter=value")
            if word[1] in values:
                raise MessageError(f"{name}: {word[1]} is given twice")
            values[word[1]] = _text_value(command, word[1], word[2])
            at = word.end()
        return encode_values(self, command, values)

    # --------------------------------------------------------------------------------------------- decode

    def decode(self, content: bytes) -> Message | None:
        """Decode one response or debug output.

        None when its id is unknown, it is cut short, or something follows it.
        """
        found = _format_at(self._by_prefix, self._responses_by_id, content, 0)
        decoded = found[0].decode(content, found[1]) if found else None
        return decoded[0] if decoded and decoded[1] == len(content) else None

    def response_at(self, content: bytes) -> "tuple[MessageFormat | OutputFormat, int] | None":
        """Return the format of the response in CONTENT and the offset of its parameters; None: unknown id."""
        return _format_at(self._by_prefix, self._responses_by_id, content, 0)

    def command_at(self, content: bytes, at: int) -> tuple[MessageFormat, int] | None:
        """Return the format of the command at AT of CONTENT and the offset of its parameters, or None."""
        return _format_at(self._commands_by_prefix, self._commands_by_id, content, at)

    def decode_commands(self, content: bytes) -> list[Message] | None:
        """Decode all commands of a block; None when any of them is unknown or cut short."""
        messages: list[Message] = []
        at = 0
        while at < len(content):
            found = self.command_at(content, at)
            if found is None:
                return None
            command, start = found
            decoded = command.decode(content, start)
            if decoded is None:
                return None
            messages.append(decoded[0])
            at = decoded[1]
        return messages


def encode_values(dictionary: Dictionary, command: MessageFormat, values: Mapping[str, Value | str]) -> bytes:
    """Encode COMMAND with enumeration names resolved; MessageError."""
    for param, value in values.items():
        if isinstance(value, str):
            values = {**values, param: _resolved(dictionary, command, param, value)}
    return command.encode(values)


def _resolved(dictionary: Dictionary, command: MessageFormat, param: str, name: str) -> int:
    enumeration = dictionary.enumeration_for(param)
    if enumeration is None:
        raise MessageError(f"{command.name}: {param} takes no names, so {name!r} cannot be its value")
    try:
        return enumeration.value_of(name)
    except MessageError as error:
        raise MessageError(f"{command.name}: {param}: {error}") from None


def _text_value(command: MessageFormat, param: str, text: str) -> Value | str:
    """Read one value of a command's text; its permitted forms depend on the parameter."""
    codes = dict(zip(command.names, command.code_texts, strict=True))
    if not codes.get(param, "").endswith("s"):
        return int(text, 0 if "x" in text else 10) if _INTEGER.match(text) else text
    if text.startswith('"'):
        return text[1:-1].replace('\\"', '"').replace("\\\\", "\\").encode()
    digits = _HEX.match(text)
    if digits is None:
        raise MessageError(f'{command.name}: {param} takes hex digits or "text", not {text!r}')
    return bytes.fromhex(digits[1])


F = TypeVar("F")


def _format_at(
    by_prefix: Mapping[bytes, F], by_id: Mapping[int, F], content: bytes, at: int
) -> tuple[F, int] | None:
    """Look up the id at AT of CONTENT; return the format with it and the offset behind it, or None."""
    found = by_prefix.get(content[at : at + 1])
    if found is not None:
        return found, at + 1
    found = by_prefix.get(content[at : at + 2])
    if found is not None:
        return found, at + 2
    number = vlq_read(content, at)  # an id in more bytes than it needs is legal
    found = by_id.get(_signed(number[0])) if number else None
    return None if found is None or number is None else (found, number[1])


def _signed(value: int) -> int:
    return value - (1 << 32) if value >> 31 else value


def _unique(pairs: list[tuple[str, object]]) -> dict[str, object]:
    found: dict[str, object] = {}
    for name, value in pairs:
        if name in found:
            raise ValueError(f"{name[:80]!r} stands twice in one object")
        found[name] = value
    return found


def _text(source: Mapping[str, object], key: str) -> str:
    value = source.get(key, "")
    if isinstance(value, str):
        return value[:1000]
    raise DictionaryError(f"dictionary: {key} must be a text")


def _constants(source: Mapping[str, object]) -> dict[str, int | float | str]:
    constants = source.get("config", {})
    if not isinstance(constants, dict):
        raise DictionaryError("dictionary: config must be an object of constants")
    for name, value in constants.items():
        if isinstance(value, bool) or not isinstance(value, int | float | str):
            raise DictionaryError(f"dictionary: constant {name[:80]!r} must be a number or a text")
    return constants


BOOTSTRAP: Final = Dictionary({})
"""The two messages every node knows before its dictionary is read."""
