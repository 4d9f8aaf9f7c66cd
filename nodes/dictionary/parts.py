"""The parts of a data dictionary: formats, debug outputs, enumerations, each checked as it is read."""

import re
from collections.abc import Mapping
from typing import Final

from nodes.dictionary.message_format import CODES, MAX_PARAMETERS, NAME, Message, MessageError, MessageFormat
from nodes.support.errors import CanductorError

OUTPUT: Final = "#output"
"""Name of the message a debug output decodes to; its one parameter ``text`` is UTF-8."""
MAX_MESSAGES: Final = 512
"""Commands, responses and outputs together; real builds have about 150."""
MAX_ENUMERATIONS: Final = 512
MAX_ENUMERATION_NAMES: Final = 1 << 14
"""Names of all enumerations together, ranges spelled out; real builds have up to 3,300."""
MAX_NAME_LENGTH: Final = 256
MAX_ID: Final = (1 << 13) - 1
"""Ids are small; two bytes of VLQ reach from -4096 to 12287."""
MIN_ID: Final = -4096
_TRAILING_NUMBER: Final = re.compile(r"(.*?)(0|[1-9][0-9]{0,9})\Z", re.DOTALL)
_OUTPUT_CODE: Final = re.compile(r"%(?:%|\.\*s|\*s|s|hu|hi|u|i|c)|%")


class DictionaryError(CanductorError):
    """A node's dictionary is garbage, hostile, or lacks what the coordinator needs."""


def _shown(name: object) -> str:
    return repr(name if not isinstance(name, str) else name[:80])


def _object(source: object, what: str, limit: int) -> dict[str, object]:
    if not isinstance(source, dict):
        raise DictionaryError(f"dictionary: {what} must be an object")
    if len(source) > limit:
        raise DictionaryError(f"dictionary: {what} has {len(source)} entries, more than {limit}; refused")
    return source


def _take_id(value: object, text: str, taken: dict[int, str]) -> int:
    if isinstance(value, bool) or not isinstance(value, int):
        raise DictionaryError(f"dictionary: the id of {_shown(text)} must be a whole number")
    if not MIN_ID <= value <= MAX_ID:
        raise DictionaryError(
            f"dictionary: the id of {_shown(text)} is {str(value)[:20]}, outside {MIN_ID}..{MAX_ID}"
        )
    if value in taken:
        raise DictionaryError(
            f"dictionary: id {value} belongs to both {_shown(taken[value])} and {_shown(text)}"
        )
    if len(taken) == MAX_MESSAGES:
        raise DictionaryError(f"dictionary: has more than {MAX_MESSAGES} messages; refused")
    taken[value] = text
    return value


# ---------------------------------------------------------------------------------------------------- formats


def parse_formats(
    source: Mapping[str, object], kind: str, taken: dict[int, str], fixed: Mapping[str, tuple[str, int]]
) -> dict[str, MessageFormat]:
    """Read the formats under KIND by name. FIXED (name: format, id) are there in any case."""
    formats: dict[str, MessageFormat] = {}
    for text, value in _object(source.get(kind, {}), kind, MAX_MESSAGES).items():
        parsed = parse_format(text, _take_id(value, text, taken))
        if parsed.name in formats:
            raise DictionaryError(f"dictionary: {kind} has {_shown(parsed.name)} twice")
        formats[parsed.name] = parsed
    for name, (text, message_id) in fixed.items():
        if name not in formats:
            formats[name] = parse_format(text, _take_id(message_id, text, taken))
        if formats[name].message_id != message_id or formats[name].text != text:
            raise DictionaryError(f"dictionary: {name} must be {text!r} with id {message_id}")
    return formats


def parse_format(text: str, message_id: int) -> MessageFormat:
    """Read ``name parameter=code …``."""
    name, *words = text.split(" ")
    if len(text) > MAX_NAME_LENGTH * 4 or len(words) > MAX_PARAMETERS:
        raise DictionaryError(f"dictionary: the format {_shown(text)} is too long; refused")
    if not NAME.match(name):
        raise DictionaryError(f"dictionary: {_shown(text)} does not start with a message name")
    names: list[str] = []
    codes: list[str] = []
    for word in words:
        param, _, code = word.partition("=")
        if not NAME.match(param) or param in names:
            raise DictionaryError(
                f"dictionary: parameter {_shown(word)} of {_shown(name)} is not a new name=code"
            )
        if code not in CODES:
            raise DictionaryError(f"dictionary: {_shown(name)} has the unknown parameter code {_shown(code)}")
        names.append(param)
        codes.append(code)
    return MessageFormat(name, message_id, names, codes)


class OutputFormat:
    """A printf-like debug text of the firmware; decodes to a Message whose ``text`` is the finished text."""

    def __init__(self, text: str, message_id: int) -> None:
        codes = [code for code in _OUTPUT_CODE.findall(text) if code != "%%"]
        if len(text) > MAX_NAME_LENGTH * 4 or len(codes) > MAX_PARAMETERS:
            raise DictionaryError(f"dictionary: the output {_shown(text)} is too long; refused")
        if "%" in codes:
            raise DictionaryError(f"dictionary: the output {_shown(text)} has an unknown code")
        self.text = text
        self.message_id = message_id
        self.format = MessageFormat(OUTPUT, message_id, [f"_{i}" for i in range(len(codes))], codes)
        self.prefix = self.format.prefix

    @classmethod
    def parse_all(cls, source: object, taken: dict[int, str]) -> "list[OutputFormat]":
        """Read the ``output`` part."""
        entries = _object(source, "output", MAX_MESSAGES)
        return [cls(text, _take_id(value, text, taken)) for text, value in entries.items()]

    def decode(self, content: bytes, start: int) -> tuple[Message, int] | None:
        """Decode like MessageFormat.decode."""
        decoded = self.format.decode(content, start)
        if decoded is None:
            return None
        values = iter(decoded[0].params.values())

        def fill(code: re.Match[str]) -> str:
            if code[0] == "%%":
                return "%"
            value = next(values)
            return value.decode(errors="backslashreplace") if isinstance(value, bytes) else str(value)

        return Message(OUTPUT, {"text": _OUTPUT_CODE.sub(fill, self.text).encode()}), decoded[1]


# ----------------------------------------------------------------------------------------------- enumerations


class Enumeration:
    """Names of numbers, ranges spelled out. Of several names for one number, decoding gives the first."""

    def __init__(self, name: str, values: Mapping[str, int]) -> None:
        self.name = name
        self.values = values
        self._names: dict[int, str] = {}
        for text, value in values.items():
            self._names.setdefault(value, text)

    def value_of(self, name: str) -> int:
        """Return the number of NAME; MessageError when there is none."""
        if name in self.values:
            return self.values[name]
        few = ", ".join(list(self.values)[:4])
        raise MessageError(f"the node has no {self.name} {name!r} (it has {few}, …)")

    def name_of(self, value: int) -> str | None:
        """Return a name of VALUE, or None."""
        return self._names.get(value)


def parse_enumerations(source: object) -> dict[str, Enumeration]:
    """Read all enumerations, bounded together."""
    found: dict[str, Enumeration] = {}
    room = MAX_ENUMERATION_NAMES
    for name, entries in _object(source, "enumerations", MAX_ENUMERATIONS).items():
        values: dict[str, int] = {}
        for entry, value in _object(entries, f"enumeration {_shown(name)}", MAX_ENUMERATION_NAMES).items():
            first, count = _range(name, entry, value)
            room -= count
            if room < 0:
                raise DictionaryError(
                    f"dictionary: enumerations name more than {MAX_ENUMERATION_NAMES} values; refused"
                )
            for text, number in _spelled_out(name, entry, first, count):
                if values.setdefault(text, number) != number:
                    raise DictionaryError(
                        f"dictionary: enumeration {_shown(name)} has two values for {_shown(text)}"
                    )
        found[name] = Enumeration(name, values)
    return found


def _range(enumeration: str, entry: str, value: object) -> tuple[int, int]:
    pair = value if isinstance(value, list) else [value, 1]
    whole = [x for x in pair if isinstance(x, int) and not isinstance(x, bool)]
    if len(pair) == len(whole) == 2:
        first, count = whole
        if -(1 << 31) <= first < 1 << 32 and 1 <= count <= MAX_ENUMERATION_NAMES:
            return first, count
    raise DictionaryError(
        f"dictionary: {_shown(entry)} of enumeration {_shown(enumeration)} must be a number or [first, count]"
    )


def _spelled_out(enumeration: str, entry: str, first: int, count: int) -> list[tuple[str, int]]:
    if len(entry) > MAX_NAME_LENGTH:
        raise DictionaryError(f"dictionary: a name of enumeration {_shown(enumeration)} is too long; refused")
    if count == 1:
        return [(entry, first)]
    numbered = _TRAILING_NUMBER.match(entry)
    if numbered is None:
        raise DictionaryError(
            f"dictionary: range {_shown(entry)} of enumeration {_shown(enumeration)} does not end in a number"
        )
    stem, number = numbered[1], int(numbered[2])
    return [(f"{stem}{number + i}", first + i) for i in range(count)]
