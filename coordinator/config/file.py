"""The configuration file as text: sections, options and where each of them stands.

Sections are ``[name]`` or ``[name instance]``, options ``option: value`` or ``option = value``; a value goes
on over indented lines. ``#`` begins a comment wherever it stands, ``;`` at the begin of a line or after
white space. Of an option that a section has twice the last one holds.
``[include FILE]`` takes wildcards. A marked block at the end holds values the machine has saved; they
override the user's own.

Nothing here knows what an option means.
"""

import re
from collections.abc import Iterable
from dataclasses import dataclass, field

from coordinator.config import text as config_text
from coordinator.config.errors import ConfigError, Place
from coordinator.config.text import ReadBudget
from coordinator.support.quoting import shown

SAVED_PREFIX = "#*#"
SAVED_HEADER = "#*# <---------------------- SAVE_CONFIG ---------------------->"
_SAVED_HEADER = re.compile(r"#\*# <-+ SAVE_CONFIG -+>\s*")
_COMMENT = re.compile(r"(?:(?<!\{)#(?!\})|(?:^|\s);).*")  # {# and #} are a template's
_SECTION = re.compile(r"\[(include .*|[^\[\]]*)\]")  # wildcards of a path may hold brackets
_SEPARATOR = re.compile(r"[:=]")
_MAX_NAME_CHARS = 200


@dataclass(slots=True)
class RawOption:
    """One option as written; the value has no comments and no outer white space; lines end in a line feed."""

    name: str
    """In lower case: names are read without regard to case."""
    value: str
    place: Place
    numbers: tuple[int, ...] = ()
    """Where each line of the value stands in the file: comments leave gaps."""
    earlier: tuple[Place, ...] = ()
    """Where it is given before, under the same header, without effect."""

    def is_at(self, place: Place) -> bool:
        """Return whether its name or any line of its value stands at PLACE."""
        return place.path == self.place.path and place.line in (self.place.line, *self.numbers)


@dataclass(slots=True)
class RawSection:
    """One section, merged from all places that name it."""

    name: str
    """As in the brackets, single blanks: ``stepper_x`` or ``mcu toolhead``."""
    place: Place
    """Where it is named first."""
    options: dict[str, RawOption] = field(default_factory=dict)
    problems: list[ConfigError] | None = None
    """Where mistakes are collected; None: the first one ends the reading."""
    set_aside: set[str] = field(default_factory=set)
    """Options that are known to be wrong and were taken out: they are not reported as missing."""
    is_set_aside: bool = False
    """Whether all of them were."""
    misspelt: bool = False
    """Whether it has an option that looks like another: then others may only seem to be too much."""
    stands_in: bool = False
    """Whether a stand-in value was used for any of its options."""
    used: dict[str, object] = field(default_factory=dict)
    """What its readers made of it so far: values and defaults, by option."""

    def report(self, error: ConfigError) -> None:
        """Raise ERROR, or collect it."""
        if self.problems is None:
            raise error
        self.problems.append(error)

    @property
    def kind(self) -> str:
        """The first word: which module the section is for."""
        return self.name.partition(" ")[0]

    @property
    def instance(self) -> str:
        """What follows the first word; empty for a plain section."""
        return self.name.partition(" ")[2]


@dataclass(slots=True)
class ConfigFile:
    """A parsed configuration."""

    path: str
    sections: dict[str, RawSection] = field(default_factory=dict)
    """By name, in the order of their first mention."""
    saved: dict[str, RawSection] = field(default_factory=dict)
    """What the SAVE_CONFIG block alone says; already merged into sections."""
    data: bytes = b""
    """The main file, untouched, for writing it back."""
    notes: list[str] = field(default_factory=list)
    """Sentences about what was read but has no effect."""
    problems: list[ConfigError] | None = None
    """Where mistakes are collected; None: the first one ends the reading."""


def parse_config(
    path: str, problems: list[ConfigError] | None = None, *, data: bytes | None = None
) -> ConfigFile:
    """Read a configuration file and all it includes; raises ConfigError.

    With PROBLEMS that is only raised for files that cannot be read: other mistakes are collected there.
    DATA: what the file is going to hold, read instead of what it holds now.
    """
    config = ConfigFile(path, problems=problems)
    budget = ReadBudget()
    place = Place(path, 0)
    config_text.enter_file(path, place, budget)
    if data is None:
        data = config_text.read_bytes(path, place, budget)
    else:
        config_text.take_bytes(data, place, budget)
    config.data = data
    lines = config_text.split_lines(config.data, path)
    header = saved_header(lines)
    _Parser(config, config.sections, budget).parse(path, enumerate(lines[:header], 1))
    saved_lines = _saved_lines(path, lines, header)
    _Parser(config, config.saved, None).parse(path, saved_lines)
    for saved in config.saved.values():
        section = config.sections.setdefault(
            saved.name, RawSection(saved.name, saved.place, problems=config.problems)
        )
        section.options.update(saved.options)
    config.notes += [
        _repeated(section, option)
        for section in config.sections.values()
        for option in section.options.values()
        if option.earlier
    ]
    return config


def _repeated(section: RawSection, option: RawOption) -> str:
    lines = ", ".join(str(place.line) for place in option.earlier)
    return (
        f"{option.place}: option {shown(option.name)} of [{section.name}] is given before (line {lines});"
        " the last one holds"
    )


def parse_saved(path: str, lines: list[str]) -> dict[str, dict[str, str]]:
    """Return what a block says, of which LINES are all; raises ConfigError."""
    config = ConfigFile(path)
    _Parser(config, config.saved, None).parse(path, _saved_lines(path, lines, 0))
    return saved_values(config)


def saved_values(config: ConfigFile) -> dict[str, dict[str, str]]:
    """Return what the block of CONFIG says."""
    return {
        section.name: {option.name: option.value for option in section.options.values()}
        for section in config.saved.values()
    }


def saved_header(lines: list[str]) -> int:
    """Return the index of the block's first line, or the number of lines when there is no block."""
    return next((i for i, line in enumerate(lines) if _SAVED_HEADER.fullmatch(line)), len(lines))


def _saved_lines(path: str, lines: list[str], header: int) -> list[tuple[int, str]]:
    """Return the numbered lines of the block without their prefix."""
    result = []
    for index in range(header + 1, len(lines)):
        line = lines[index]
        if line.startswith(SAVED_PREFIX):
            result.append((index + 1, line[len(SAVED_PREFIX) :].removeprefix(" ")))
        elif line.strip():
            raise ConfigError(
                Place(path, index + 1),
                f"text below the SAVE_CONFIG block of line {header + 1}; move it above the block",
            )
    # The notice that the block is written by the machine is the only prose in it.
    return [(number, line) for number, line in result if not line.startswith("DO NOT EDIT")]


class _Parser:
    """Turns one file's numbered lines into sections; follows includes as they come."""

    def __init__(
        self, config: ConfigFile, sections: dict[str, RawSection], budget: ReadBudget | None
    ) -> None:
        self._config = config
        self._sections = sections  # may have been begun by another file
        self._budget = budget  # none: includes are refused
        self._section: RawSection | None = None
        self._here: dict[str, RawOption] = {}  # under the last header, where a repeat is worth a notice
        self._option: RawOption | None = None
        self._option_indent = 0
        self._value: list[tuple[int, str]] = []

    def parse(self, path: str, lines: Iterable[tuple[int, str]]) -> None:
        """Read all lines of a file; raises ConfigError."""
        for number, line in lines:
            text = _COMMENT.sub("", line, count=1).rstrip()
            indent = len(text) - len(text.lstrip())
            if not text:
                # A blank line may stand inside a value, a comment leaves no trace in it.
                if not line.strip():
                    self._value.append((number, ""))
            elif self._option is not None and indent > self._option_indent:
                self._value.append((number, text.strip()))
            else:
                self._end_option()
                self._begin_or_report(text.strip(), indent, Place(path, number))
        self._end_option()

    def _begin_or_report(self, text: str, indent: int, place: Place) -> None:
        try:
            self._begin(text, indent, place)
        except ConfigError as error:
            if self._config.problems is None:
                raise
            self._config.problems.append(error)

    def _begin(self, text: str, indent: int, place: Place) -> None:
        """Take a line that is not a value's continuation."""
        if not text.startswith("["):
            self._option, first = _option(text, place)
            self._value, self._option_indent = [(place.line, first)], indent
            _add(self._section, self._here, self._option)
            return
        name = _section_name(text, place)
        kind, _, pattern = name.partition(" ")
        self._here = {}
        if kind == "include":
            self._section = None
            self._include(pattern, place)
        else:
            new = RawSection(name, place, problems=self._config.problems)
            self._section = self._sections.setdefault(name, new)

    def _end_option(self) -> None:
        if self._option is not None:
            while self._value and not self._value[0][1]:
                del self._value[0]
            self._option.value = "\n".join(text for _, text in self._value).rstrip()
            self._option.numbers = tuple(number for number, _ in self._value)
        self._option = None
        self._value = []

    def _include(self, pattern: str, place: Place) -> None:
        if self._budget is None:
            raise ConfigError(place, "the SAVE_CONFIG block cannot include files")
        if not pattern:
            raise ConfigError(place, "[include] needs a file name: [include other.cfg]")
        for path in config_text.included_paths(pattern, place, self._budget):
            config_text.enter_file(path, place, self._budget)
            lines = config_text.read_lines(path, place, self._budget)
            header = saved_header(lines)
            if header < len(lines):
                where = Place(path, header + 1)
                self._config.notes.append(f"{where}: the SAVE_CONFIG block of an included file is not read")
            _Parser(self._config, self._sections, self._budget).parse(path, enumerate(lines[:header], 1))
            self._budget.open_files.pop()


def _section_name(text: str, place: Place) -> str:
    match = _SECTION.fullmatch(text.replace("\t", " "))
    name = " ".join(match[1].split()) if match else ""
    if match is None or not name or len(name) > _MAX_NAME_CHARS:
        raise ConfigError(place, f"{shown(text)} is not a section header; write [name] or [name instance]")
    return name


def _option(text: str, place: Place) -> tuple[RawOption, str]:
    separator = _SEPARATOR.search(text)
    name = text[: separator.start()].rstrip().lower() if separator else ""
    if separator is None or not name or len(name) > _MAX_NAME_CHARS:
        raise ConfigError(
            place, f"{shown(text)} is neither a section header nor an option; write 'option: value'"
        )
    return RawOption(name, "", place), text[separator.end() :].lstrip()


def _add(section: RawSection | None, here: dict[str, RawOption], option: RawOption) -> None:
    if section is None:
        raise ConfigError(
            option.place,
            f"option {shown(option.name)} stands outside of a section; put a [section] before it",
        )
    before = here.get(option.name)
    if before is not None:
        option.earlier = (*before.earlier, before.place)
    here[option.name] = section.options[option.name] = option
