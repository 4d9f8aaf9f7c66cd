"""``canductor can dissector``: writes a Wireshark dissector of the protocol, in Lua.

Its tables come from ``protocol`` and from the dictionaries given, as the project's own decoder has them; the
code behind them is in PARTS. The result is one file that needs nothing else.
"""

import argparse
import os
import sys
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Any, Final

from canbus_tools.protocol.blocks import GAP_S, NOISE_SHOWN
from canbus_tools.protocol.decoded import quoted
from canbus_tools.protocol.dictionaries import read_dictionary
from canbus_tools.protocol.flow import REPEAT_S
from canbus_tools.protocol.protocol import ADMIN_FRAMES, BLOCK, SIGNAL_FRAMES, Field, FieldKind, FrameFormat
from nodes.dictionary.dictionary import BOOTSTRAP, Dictionary
from nodes.dictionary.message_format import CODES, MessageFormat
from nodes.dictionary.parts import OutputFormat
from nodes.support.can_protocol import DATA_NODEID_MAX, FIRST_DATA_ID
from nodes.support.errors import CanductorError
from nodes.support.option_values import Assignments, UsageError, options_from, parse_int

WIDTHS: Final = {"%u": 32, "%i": 32, "%hu": 16, "%hi": 16, "%c": 8}
"""Bits of a number with this code."""
_KINDS: Final = {FieldKind.UNSIGNED: "number", FieldKind.HEX: "hex", FieldKind.UUID: "uuid"}
ANY: Final = "any"
PARTS: Final = (
    "dissector_fields.lua",
    "dissector_values.lua",
    "dissector_read.lua",
    "dissector_show.lua",
)
"""The Lua code, which becomes one file."""
HEAD: Final = """\
-- A Wireshark dissector of the protocol that Klipper's firmware and canductor's speak over CAN.
-- Made by `canductor can dissector`; do not edit it, make it again.
-- It goes into Wireshark's folder of personal Lua plugins (Help, About, Folders), or is loaded by
-- `tshark -X lua_script:FILE`.
"""


@dataclass(frozen=True, slots=True, kw_only=True)
class DissectorOptions:
    """What is to be written."""

    output: Path | None = None
    """None: standard output."""
    dictionaries: Mapping[int | str, Path]
    """By node id, or ANY for all other nodes."""
    json: bool = False


def declare(command: argparse.ArgumentParser) -> None:
    """Add the options of this tool."""
    add = command.add_argument
    add("-o", "--output", type=Path, metavar="FILE", help="file to write (default: standard output)")
    add(
        "--dictionary",
        dest="dictionaries",
        type=_node_file,
        action=Assignments,
        everything="all nodes",
        metavar="[NODE=]FILE",
        help="decode the messages of node NODE, or of all other nodes, by this dictionary (JSON, or as"
        " downloaded); without one, only dictionary downloads are decoded",
    )


def _node_file(text: str) -> tuple[int | str, Path]:
    node, equals, name = text.partition("=")
    if equals and node.isdecimal():
        return parse_int(node, 1, DATA_NODEID_MAX, name="NODE"), Path(name)
    return "", Path(text)


def make_job(given: argparse.Namespace) -> Callable[[object], "DissectorReport"]:
    """Check what was given; raises UsageError."""
    if given.json and given.output is None:
        raise UsageError("--json needs --output, as both would go to standard output")
    dictionaries = {node or ANY: path for node, path in given.dictionaries.items()}
    options = options_from(DissectorOptions, given, dictionaries=dictionaries)
    return lambda _: write_dissector(options)


def write_dissector(options: DissectorOptions) -> "DissectorReport":
    """Write the file; raises CanductorError."""
    dictionaries = {key: read_dictionary(path) for key, path in options.dictionaries.items()}
    text = dissector(dictionaries)
    if options.output is None:
        sys.stdout.write(text)
    else:
        try:
            options.output.write_text(text, encoding="utf-8")
        except OSError as error:
            reason = os.strerror(error.errno) if error.errno else str(error)
            raise CanductorError(f"dissector '{options.output}' cannot be written: {reason}") from None
    return DissectorReport(output=options.output, messages=_count(dictionaries.values()))


@dataclass(frozen=True, slots=True, kw_only=True)
class DissectorReport:
    """What was written."""

    output: Path | None
    messages: int
    """Formats in the dictionaries given."""

    @property
    def ok(self) -> bool:
        """Always: what fails raises."""
        return True

    def to_json(self) -> Mapping[str, object]:
        """Return the figures."""
        return {"output": str(self.output), "messages": self.messages}

    def to_text(self) -> str:
        """Tell how to use it; nothing when it went to standard output."""
        if self.output is None:
            return ""
        known = f"{self.messages} messages" if self.messages else "no messages but a dictionary's download"
        return (
            f"{self.output} decodes {known}; put it into Wireshark's folder of personal Lua plugins, or use"
            f" tshark -X lua_script:{self.output}"
        )


def _count(dictionaries: Iterable[Dictionary]) -> int:
    return sum(len(d.commands) + len(d.responses) + len(d.outputs) for d in dictionaries)


# ---------------------------------------------------------------------------------------------------- tables


def dissector(dictionaries: Mapping[int | str, Dictionary]) -> str:
    """Return the dissector with these dictionaries, by node id or ANY."""
    folder = resources.files("canbus_tools.dissector")
    code = "".join(folder.joinpath(part).read_text(encoding="utf-8") for part in PARTS)
    return f"{HEAD}\nlocal D = {lua(tables(dictionaries))}\n\n{code}"


def tables(dictionaries: Mapping[int | str, Dictionary]) -> dict[str, Any]:
    """Return all that the Lua code knows of the protocol."""
    known = {ANY: BOOTSTRAP, **dictionaries}
    numbers, buffers = _params(known.values())
    frames = [_frame("admin", f) for f in ADMIN_FRAMES] + [_frame("signal", f) for f in SIGNAL_FRAMES]
    return {
        "frames": frames,
        "fields": {f.name: _field(f) for known_ in (*ADMIN_FRAMES, *SIGNAL_FRAMES) for f in known_.fields},
        "first_data_id": FIRST_DATA_ID,
        "nodeid_max": DATA_NODEID_MAX,
        "block": {
            "length_min": BLOCK.length_min,
            "length_max": BLOCK.length_max,
            "sequence_mark": BLOCK.sequence_mark,
            "content_at": BLOCK.content_at,
            "crc_polynomial": BLOCK.crc_polynomial,
            "crc_start": BLOCK.crc_start,
            "sync": BLOCK.sync,
        },
        "gap_s": GAP_S,
        "noise_shown": NOISE_SHOWN,
        "repeat_s": REPEAT_S,
        "widths": WIDTHS,
        "signed": {code: CODES[code].field == "i" for code in WIDTHS},
        "number_params": numbers,
        "buffer_params": buffers,
        "dictionaries": {key: _dictionary(value) for key, value in known.items()},
    }


def _frame(kind: str, known: FrameFormat) -> dict[str, Any]:
    return {
        "kind": kind,
        "name": known.name,
        "direction": known.direction.value,
        "can_id": known.can_id,
        "ids": known.ids,
        "command": known.command,
        "size": known.size,
        "fields_at": known.fields_at,
        "fields": [f.name for f in known.fields],
        "extension": known.extension,
        "sentence": known.sentence,
    }


def _field(field: Field) -> dict[str, Any]:
    return {
        "label": field.name.replace("_", " ").capitalize(),
        "size": field.size,
        "kind": _KINDS[field.kind],
        "values": dict(field.values) or None,
    }


def _params(dictionaries: Iterable[Dictionary]) -> tuple[list[str], list[str]]:
    """Return the names of all parameters that are numbers, and of those that are buffers."""
    numbers: set[str] = set()
    buffers: set[str] = set()
    for dictionary in dictionaries:
        for format_ in (*dictionary.commands.values(), *dictionary.responses.values()):
            for name, code in zip(format_.names, format_.code_texts, strict=True):
                (numbers if code in WIDTHS else buffers).add(name)
    return sorted(numbers), sorted(buffers)


def _dictionary(dictionary: Dictionary) -> dict[str, Any]:
    outputs = {f.message_id: _output(f) for f in dictionary.outputs}
    return {
        "commands": {f.message_id: _message(f, dictionary) for f in dictionary.commands.values()},
        "responses": {f.message_id: _message(f, dictionary) for f in dictionary.responses.values()} | outputs,
        "enumerations": {
            enumeration.name: {
                # In this order, because the first name of several for one number is the one that is shown.
                number: quoted(text)
                for text, number in reversed(list(enumeration.values.items()))
            }
            for enumeration in dictionary.enumerations.values()
        },
    }


def _message(format_: MessageFormat, dictionary: Dictionary) -> dict[str, Any]:
    found = [dictionary.enumeration_for(name) for name in format_.names]
    return {
        "name": format_.name,
        "names": list(format_.names),
        "codes": list(format_.code_texts),
        "enumerations": ["" if enumeration is None else enumeration.name for enumeration in found],
    }


def _output(format_: OutputFormat) -> dict[str, Any]:
    plain = format_.format
    return {"name": plain.name, "names": [], "codes": list(plain.code_texts), "text": format_.text}


def lua(value: object) -> str:
    """Return VALUE as a Lua expression. Lists and mappings become tables, in which None is left out."""
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, int | float):
        return repr(value)
    if isinstance(value, str):
        return '"' + "".join(_escaped(byte) for byte in value.encode()) + '"'
    if isinstance(value, Mapping):
        pairs = (f"[{lua(key)}]={lua(item)}" for key, item in value.items() if item is not None)
        return "{" + ",\n".join(pairs) + "}"
    if isinstance(value, list):
        return "{" + ",".join(lua(item) for item in value) + "}"
    raise TypeError(f"{value!r} has no form in Lua")


def _escaped(byte: int) -> str:
    plain = 0x20 <= byte < 0x7F and chr(byte) not in '"\\'
    return chr(byte) if plain else f"\\{byte:03d}"
