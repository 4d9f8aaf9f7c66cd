"""Reads one G-code line that the hot path left to Python. Never raises anything but WordError."""

import re
from collections.abc import Container, Iterable, Mapping
from dataclasses import dataclass
from functools import lru_cache, reduce
from operator import xor

from nodes.support.numbers import read_decimal
from nodes.support.terminal import printable_lines

_CODE = re.compile(r"([GMTgmt])(\d{1,9})(\.\d{1,9})?(?![\d_.])", re.ASCII)
_NAME = re.compile(r"[A-Za-z_]\w*(?=[ \t;]|$)", re.ASCII)
_BARE_WORD = re.compile(r"[XYZEFxyzef][+-]?\.?\d", re.ASCII)
_LINE_NUMBER = re.compile(rb"[Nn]\d+[ \t]*")
_WORD = re.compile(r"\s*([A-Za-z])([+-]?(?:\d+(?:\.\d*)?|\.\d+)|(?=\s|$))\s*", re.ASCII)
_PARAMETER = re.compile(r"\s*([A-Za-z_]\w*)=(\"[^\"]*\"|'[^']*'|\S*)(?:\s+|$)", re.ASCII)
_UNCOMMENTED = re.compile(r"(?:=\"[^\"]*\"|='[^']*'|[^;])*")
"""Parameters: a semicolon in the quotes of a value begins no comment."""
_PLAIN = re.compile(r"[\w.+-]+", re.ASCII)
_LETTERS = "ABCDEFGHIJKLMNOPQRSTUVWXYZ"
_TEXTS = frozenset({"23", "117", "118"})
"""M-codes that a text follows."""
_QUOTED_MAX = 40
_LINE_MAX = 4096


class WordError(ValueError):
    """What is wrong with a line, as the end of a sentence."""


@dataclass(frozen=True, slots=True)
class Command:
    """One command: its NAME (``G1``, ``M204``, ``SET_VELOCITY_LIMIT``) and the text of its parameters."""

    name: str
    text: str
    written: str = ""
    """In capitals as it stands in the line, where that is not NAME: ``G00``, ``M104.0``."""
    taken: dict[str, bool] | None = None
    """Collects whether any reader took a parameter, for a notice of others; None: they are not reported."""

    def called(self, name: str) -> "Command":
        """Return the same command under another NAME."""
        return Command(name, self.text, taken=self.taken)

    def only_words(self, known: str) -> dict[str, str]:
        """Read the parameters as letters with numbers; what is none of KNOWN is ignored."""
        return self._only(self.words(known), known)

    def only_parameters(self, known: Iterable[str]) -> dict[str, str]:
        """Read the parameters as NAME=VALUE; what is none of KNOWN is ignored."""
        return self._only(self.parameters(), tuple(known))

    def _only(self, found: dict[str, str], known: Container[str]) -> dict[str, str]:
        if self.taken is not None:
            for key in found:
                self.taken[key] = self.taken.get(key, False) or key in known
        return {key: text for key, text in found.items() if key in known}

    def words(self, known: str = _LETTERS) -> dict[str, str]:
        """Read the parameters as letters with numbers (or without: ``G28 X``).

        Words may follow each other without blanks (``G1X1E2``), but only those of KNOWN: else ``S1e9`` and
        ``S0x5`` would be S1 and S0.
        """
        words: dict[str, str] = {}
        at = began = 0
        while at < len(self.text):
            match = _WORD.match(self.text, at)
            if not match:
                raise WordError(
                    f"{self.name} has {quoted(self.text[at:])} where a letter and a number belong"
                )
            letter = match[1].upper()
            if letter in words:
                raise WordError(f"{self.name} has {letter} twice; leave one")
            if letter not in known and at and not self.text[at - 1].isspace():
                raise _no_number(self.name, self.text[began], self.text[began + 1 :].split()[0])
            words[letter] = match[2]
            began, at = at, match.end()
        return words

    def parameters(self) -> dict[str, str]:
        """Read the parameters as NAME=VALUE."""
        parameters: dict[str, str] = {}
        at = 0
        while at < len(self.text):
            match = _PARAMETER.match(self.text, at)
            if not match:
                raise WordError(f"{self.name} has {quoted(self.text[at:])} where NAME=VALUE belongs")
            parameters[match[1].upper()] = _unquoted(match[2])
            at = match.end()
        return parameters


def _unquoted(text: str) -> str:
    return text[1:-1] if len(text) > 1 and text[0] in "\"'" and text[-1] == text[0] else text.strip('"')


def quoted(text: str) -> str:
    """Return TEXT in quotes, short and printable."""
    return ascii(text if len(text) <= _QUOTED_MAX else text[:_QUOTED_MAX] + "...")


def command_line(name: str, **parameters: str | float) -> str:
    """Return the line that is read as the command NAME with PARAMETERS, whatever they hold.

    Raises WordError where no line can say it: nothing in a parameter becomes a command or another parameter.
    """
    texts = {key: text if isinstance(text, str) else f"{text:.12g}" for key, text in parameters.items()}
    words = [name]
    for key, text in texts.items():
        quote = "'" if '"' in text else '"'
        words.append(f"{key}={text}" if _PLAIN.fullmatch(text) else f"{key}={quote}{text}{quote}")
    line = " ".join(words)
    found = None if "\n" in line else parse(line.encode(errors="replace"))
    if found is None or found.name != name or found.parameters() != texts:
        given = ", ".join(f"{key}={quoted(text)}" for key, text in texts.items())
        raise WordError(f"{name} cannot be written with {given}; use names without ; and quotes")
    return line


def number(what: str, words: Mapping[str, str], key: str) -> float:
    """Return the number of WORDS[KEY]; WHAT is the command's name."""
    text = words[key]
    if not text:
        raise WordError(f"{key} of {what} has no number; write {key} and a decimal number")
    value = read_decimal(text)
    if value is None:
        raise _no_number(what, key, text)
    return value


def _no_number(what: str, key: str, text: str) -> WordError:
    return WordError(f"{key} of {what} is {quoted(text)}, which is not a number, or is out of range")


@lru_cache(maxsize=256)  # slicers repeat few different lines, thousands of times
def parse(line: bytes) -> Command | None:
    """Read LINE; None when there is nothing to do. Raises WordError."""
    if len(line) > _LINE_MAX:
        raise WordError(f"this command is longer than {_LINE_MAX} bytes; is this a G-code file?")
    text = printable_lines(_without_frame(line.strip(b" \t\r\n")).decode("utf-8", "replace"))
    if text.startswith("("):
        text = _without_comments(text)
    text = text.strip()
    if not text or text[0] in ";%":
        return None
    if match := _CODE.match(text):
        fraction = (match[3] or "").rstrip("0").rstrip(".")
        rest = text[match.end() :]
        name, written = match[1].upper() + str(int(match[2])) + fraction, match[0].upper()
        # Display texts (M117, M118) and the name of a file (M23) are not words and may hold parentheses.
        return Command(
            name,
            rest if match[1] in "Mm" and match[2] in _TEXTS else _without_comments(rest).strip(),
            written if written != name else "",
        )
    if _BARE_WORD.match(text):
        raise WordError(f"{quoted(text)} has no command; write G0 or G1 before the axes")
    if match := _NAME.match(text):
        parameters = _UNCOMMENTED.match(text, match.end())
        return Command(match[0].upper(), parameters[0].strip() if parameters else "")
    raise WordError(f"cannot read {quoted(text)}; it is neither a G-code command nor a comment")


def _without_comments(text: str) -> str:
    """Cut ``; ...`` and ``(...)`` out."""
    kept: list[str] = []
    at = 0
    while True:
        open_, semicolon = text.find("(", at), text.find(";", at)
        if semicolon >= 0 and (open_ < 0 or semicolon < open_):
            return "".join([*kept, text[at:semicolon]])
        if open_ < 0:
            return "".join([*kept, text[at:]])
        close = text.find(")", open_)
        if close < 0:
            raise WordError(f"the comment {quoted(text[open_:])} does not end; close the parenthesis")
        kept += [text[at:open_], " "]
        at = close + 1


def _without_frame(line: bytes) -> bytes:
    """Strip the line number and check the checksum, if any.

    A star in a line without a number begins a checksum only where digits follow: it may stand in a text.
    """
    numbered = _LINE_NUMBER.match(line)
    code = line.split(b";")[0]
    is_code = numbered or (line[:1] in b"GMTgmt" and line[1:2].isdigit())
    counted, star, sum_ = code.rpartition(b"*")
    given = sum_.strip(b" \t")
    if is_code and star and (given.isdigit() or numbered):
        expected = reduce(xor, counted, 0)
        if given != b"%d" % expected:
            text = quoted(given.decode("ascii", "replace"))
            raise WordError(
                f"the checksum is {text}, but the line adds up to {expected}; copy the file again"
            )
        line = counted
    return line[numbered.end() :] if numbered else line
