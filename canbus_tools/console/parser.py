"""What is typed at the console: read, completed, and turned into the values of a node's command. Sans-IO."""

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Final, NamedTuple

from canbus_tools.console.expressions import ExpressionError, Quantity, evaluate, names_in
from nodes.dictionary.dictionary import Dictionary
from nodes.dictionary.message_format import MessageError, MessageFormat, Value
from nodes.support.errors import CanductorError

LINE_MAX: Final = 2000
"""Characters of a line."""
OWN: Final[Mapping[str, tuple[str, str]]] = {
    "/help": ("", "show this"),
    "/list": ("[PART]", "commands, responses, enumerations and constants whose names have PART"),
    "/stats": ("", "counters of the link: round trips, repeats, invalid bytes"),
    "/repeat": ("N [INTERVAL] COMMAND", "send a command N times, every INTERVAL (50ms, 2s)"),
    "/delay": ("TIME", "wait (50ms, 2s)"),
    "/set": ("NAME EXPRESSION", "define NAME as a value; without arguments: show all names"),
    "/eval": ("EXPRESSION", "show the value of an expression"),
    "/hide": ("[NAME …]", "hide these messages unless they answer a command; without names: show all"),
    "/quit": ("", "end; so does Ctrl-D"),
}
"""The console's own commands: what they take, and what they do."""
DURATION_MAX_S: Final = 86_400
_ARGUMENT: Final = re.compile(r'([A-Za-z_]\w*)\s*=(?!=)\s*("(?:[^"\\]|\\.)*"|.*?)\s*(?=$|\s[A-Za-z_]\w*\s*=)')
_HEX: Final = re.compile(r"(?:0x)?((?:[0-9a-fA-F]{2})*)\Z")
_QUERY_WORDS: Final = frozenset({"get", "query"})
_OTHER_ANSWERS: Final[Mapping[str, str]] = {
    "debug_read": "debug_result",
    "trsync_trigger": "trsync_state",
    "neopixel_send": "neopixel_result",
    "tmcuart_send": "tmcuart_response",
}


class ConsoleError(CanductorError):
    """What was typed is no command."""


@dataclass(frozen=True, slots=True)
class NodeCommand:
    """A command for the node: its parameters as they were typed."""

    name: str
    args: Mapping[str, str]


@dataclass(frozen=True, slots=True)
class OwnCommand:
    """A command for the console, and what follows it."""

    name: str
    rest: str


Command = NodeCommand | OwnCommand


def read_line(text: str) -> Command | None:
    """Return what a line says, None when it is empty or a comment; ConsoleError."""
    if len(text) > LINE_MAX:
        raise ConsoleError(f"the line has {len(text)} characters; at most {LINE_MAX} are read")
    line = _without_comment(text).strip()
    if not line:
        return None
    name, _, rest = line.partition(" ")
    rest = rest.strip()
    if name.startswith("/"):
        found = [own for own in OWN if own.startswith(name) and len(name) > 1]
        if name in OWN or len(found) == 1:
            return OwnCommand(name if name in OWN else found[0], rest)
        raise ConsoleError(f"the console has no command '{name}'; /help lists those it has")
    return NodeCommand(name, _arguments(name, rest))


def _without_comment(text: str) -> str:
    quoted = False
    for at, letter in enumerate(text):
        if letter == '"' and text[at - 1 : at] != "\\":
            quoted = not quoted
        elif letter == "#" and not quoted and (at == 0 or text[at - 1].isspace()):
            return text[:at]
    return text


def _arguments(name: str, text: str) -> dict[str, str]:
    args: dict[str, str] = {}
    at = 0
    while at < len(text):
        found = _ARGUMENT.match(text, at)
        if found is None or not found[2]:
            raise ConsoleError(f"{name}: '{text[at : at + 40]}' is not parameter=value")
        if found[1] in args:
            raise ConsoleError(f"{name}: {found[1]} is given twice")
        args[found[1]] = found[2]
        at = found.end()
        at += len(text[at:]) - len(text[at:].lstrip())
    return args


def read_duration_s(text: str) -> float:
    """Return a time such as ``50ms`` or ``2*50ms`` in seconds; ConsoleError."""
    per_s = 1_000_000_000
    timed, plain = (evaluate(text, {}, freq_hz) for freq_hz in (per_s, 2 * per_s))
    # A time counts in ticks: at twice the frequency there are twice as many.
    if timed.value * 2 != plain.value or not 0 <= timed.value <= DURATION_MAX_S * per_s:
        raise ConsoleError(f"'{text}' is no time from 0 s to {DURATION_MAX_S} s; write 50ms or 2s")
    return float(timed.value / per_s)


def read_repeat(rest: str) -> tuple[int, float, str]:
    """Return how often, every how many seconds, and what; ConsoleError."""
    count, _, then = rest.partition(" ")
    first, _, after = then.strip().partition(" ")
    interval_s, command = 0.0, then.strip()
    if first[:1].isdigit() or first[:1] == ".":
        interval_s, command = read_duration_s(first), after.strip()
    if not count.isascii() or not count.isdecimal() or not 1 <= len(count) <= 7 or not command:
        raise ConsoleError("/repeat takes a number up to 9999999, an interval if wanted, and a command")
    if isinstance(read_line(command), OwnCommand) and not command.startswith(("/eval", "/stats", "/delay")):
        raise ConsoleError("/repeat repeats commands of the node, /eval, /stats and /delay")
    return int(count), interval_s, command


# --------------------------------------------------------------------------------------------------- values


def names_wanted(dictionary: Dictionary, command: NodeCommand) -> set[str]:
    """Return the names that the command's values refer to."""
    format_ = dictionary.commands.get(command.name)
    wanted: set[str] = set()
    for param, text in command.args.items():
        if format_ is not None and _code(format_, param).endswith("s"):
            continue
        enumeration = dictionary.enumeration_for(param)
        if enumeration is None or text.strip('"') not in enumeration.values:
            wanted |= names_in(text)
    return wanted


def values_of(
    dictionary: Dictionary, command: NodeCommand, names: Mapping[str, Quantity]
) -> dict[str, Value | str]:
    """Return the values of a command's parameters; ConsoleError, MessageError."""
    format_ = _command(dictionary, command.name)
    return {param: _value(dictionary, format_, param, text, names) for param, text in command.args.items()}


def _value(
    dictionary: Dictionary, format_: MessageFormat, param: str, text: str, names: Mapping[str, Quantity]
) -> Value | str:
    if param not in format_.names:
        raise ConsoleError(f"{format_.name} has no parameter '{param}'; it is '{format_.text}'")
    if _code(format_, param).endswith("s"):
        return _buffer(format_.name, param, text)
    enumeration = dictionary.enumeration_for(param)
    if enumeration is not None and text.strip('"') in enumeration.values:
        return enumeration.values[text.strip('"')]
    try:
        code = format_.codes[format_.names.index(param)]
        return evaluate(text, names, frequency_hz(dictionary)).for_range(code.low, code.high)
    except ExpressionError as error:
        also = ""
        if enumeration is not None:
            also = f"; nor is it a {enumeration.name}: {_few(enumeration.values)}"
        raise ConsoleError(f"{format_.name}: {param}: {error}{also}") from None


def _command(dictionary: Dictionary, name: str) -> MessageFormat:
    try:
        return dictionary.command(name)
    except MessageError as error:
        near = [known for known in dictionary.commands if name in known or known in name]
        raise ConsoleError(
            f"{error}; {'did you mean ' + _few(near) if near else '/list shows all'}"
        ) from None


def _few(names: Iterable[str]) -> str:
    some = list(names)
    return ", ".join(some[:6]) + (", …" if len(some) > 6 else "")


def _code(format_: MessageFormat, param: str) -> str:
    return format_.code_texts[format_.names.index(param)] if param in format_.names else ""


def _buffer(name: str, param: str, text: str) -> bytes:
    if text.startswith('"'):
        return re.sub(r"\\(.)", r"\1", text[1:-1]).encode()
    digits = _HEX.match("".join(text.split()))
    if digits is None:
        raise ConsoleError(f"{name}: {param} takes hex digits or \"text\", not '{text}'")
    return bytes.fromhex(digits[1])


def frequency_hz(dictionary: Dictionary) -> int | None:
    """Return how fast the node's clock is, None when its dictionary does not say."""
    freq_hz = dictionary.constants.get("CLOCK_FREQ")
    return freq_hz if isinstance(freq_hz, int) and 0 < freq_hz < 1 << 32 else None


def answer_to(dictionary: Dictionary, name: str) -> str | None:
    """Return the response that answers a command, as firmware names them; None when none is known.

    Dictionaries do not say it: ``get_clock`` is answered by ``clock``, ``endstop_query_state`` by
    ``endstop_state``, ``spi_transfer`` by ``spi_transfer_response``.
    """
    rest = "_".join(word for word in name.split("_") if word not in _QUERY_WORDS)
    for response in (rest if rest != name else "", f"{name}_response", _OTHER_ANSWERS.get(name, "")):
        if response in dictionary.responses:
            return response
    return None


def may_repeat(name: str) -> bool:
    """Return whether a command is only a query, which can be repeated when its answer got lost."""
    return name == "identify" or bool(_QUERY_WORDS.intersection(name.split("_")))


# ----------------------------------------------------------------------------------------------- completion


class Candidate(NamedTuple):
    """What could stand at the end of a line."""

    text: str
    replaces: int
    """Characters before the cursor that it takes the place of."""
    note: str = ""


def complete(dictionary: Dictionary, names: Iterable[str], line: str) -> list[Candidate]:
    """Return what can come next in LINE, which ends at the cursor."""
    words = line.lstrip()
    if words.startswith("/"):
        name, space, rest = words.partition(" ")
        if not space:
            return [Candidate(own, len(name), OWN[own][0]) for own in OWN if own.startswith(name)]
        if name in ("/eval", "/set", "/delay"):
            return _name_candidates(names, words)
        if name != "/repeat":
            return []
        words = re.sub(r"^\s*\d+\s+([0-9.]+\w+\s+)?", "", rest, count=1)
        if words == rest:
            return []
    name, space, rest = words.partition(" ")
    if not space:
        return [
            Candidate(format_.name, len(name), " ".join(format_.names))
            for format_ in dictionary.commands.values()
            if format_.name.startswith(name)
        ]
    format_of = dictionary.commands.get(name)
    return [] if format_of is None else _parameters(dictionary, format_of, names, rest)


def _parameters(
    dictionary: Dictionary, format_: MessageFormat, names: Iterable[str], rest: str
) -> list[Candidate]:
    value = re.search(r"(?:^|\s)([A-Za-z_]\w*)=(\S*)$", rest)
    if value is not None and value[1] in format_.names:
        enumeration = dictionary.enumeration_for(value[1])
        known: Sequence[str] = list(enumeration.values) if enumeration else ()
        found = [Candidate(name, len(value[2])) for name in known if name.startswith(value[2])]
        return found or _name_candidates(names, value[2])
    given = set(re.findall(r"([A-Za-z_]\w*)\s*=", rest))
    word = re.search(r"[A-Za-z_]?\w*$", rest)
    typed = word[0] if word else ""
    return [
        Candidate(f"{name}=", len(typed), code)
        for name, code in zip(format_.names, format_.code_texts, strict=True)
        if name not in given and name.startswith(typed)
    ]


def _name_candidates(names: Iterable[str], text: str) -> list[Candidate]:
    word = re.search(r"[A-Za-z_]\w*$", text)
    typed = word[0] if word else ""
    return [Candidate(name, len(typed)) for name in sorted(names) if name.startswith(typed)]
