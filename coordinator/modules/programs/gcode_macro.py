"""[gcode_macro NAME]: a command that is replaced by lines of g-code, which a template renders."""

import ast
import math
import re
from collections.abc import Iterator, Mapping
from typing import Any, Final

from coordinator.config.errors import ConfigError, Place
from coordinator.config.options import GCodeOption, Option, SectionSpec, TextOption
from coordinator.gcode.commands import Call, GCodeCommand, Immediate, Lines, Reading
from coordinator.gcode.parameters import needed, one
from coordinator.gcode.parser import Command, WordError, parse, quoted
from coordinator.gcode.templates.renderer import Actions
from coordinator.gcode.templates.templates import Asked, Template, TemplateError, line_of
from coordinator.modules.base import Build, Module, Modules
from coordinator.modules.status.printer_status import PrinterStatus
from coordinator.support.values import Value

GCODE = GCodeOption(name="gcode", help="g-code to run, a Jinja2 template with { } and {% %}")
RENAME = TextOption(
    name="rename_existing",
    help="Name for the command that had this macro's name before, such as M109.1 or BASE_PAUSE",
    pattern=r"\S+",
    pattern_rule="one word",
)
DESCRIPTION = TextOption(
    name="description",
    help="A sentence about it, also over several lines",
    default="G-Code macro",
    pattern=r"(?s).*",
    pattern_rule="text",
)
VARIABLE = TextOption(
    name="variable_", help="First value of a variable, as Python writes it: 1, 0.5, 'text', True, [1, 2]"
)
_NAMES = re.compile(r"[A-Za-z_][\w.]*", re.ASCII)
VALUE_MAX: Final = 10_000
"""Characters of a variable's value."""
INTEGER_MAX: Final = 2**53 - 1
"""Every reader of JSON has it exactly, browsers and templates' numbers included; msgpack ends at 64 bits."""


class GCodeTemplate:
    """An option with lines of g-code: a template, and where each of its lines stands; raises ConfigError."""

    def __init__(self, build: Build, option: Option[str]) -> None:
        text = self.text = build.get(option)
        raw = build.reader.section.options.get(option.name)
        self.section = build.name
        self._path = build.reader.place_of(option).path
        self._numbers = raw.numbers if raw is not None else ()
        self._status = build.shared(PrinterStatus)
        try:
            self._template = Template(text)
        except TemplateError as error:
            place = Place(self._path, line_of(self._numbers, error.line))
            raise ConfigError(place, f"the template of [{build.name}]: {error}") from None
        if not self._template.plain:
            self._status.add_template(text)

    def lines(self, call: Call, values: Mapping[str, object]) -> Lines:
        """Render it for CALL with further VALUES; raises WordError."""
        try:
            made = self._template.render(values, self._status.view(call))
        except Asked as asked:
            replies = self._carry_out(asked.actions)
            if asked.emergency:
                return Lines("M112", (*replies, *([str(asked)] if str(asked) else [])))
            raise WordError(str(asked)) from None
        except TemplateError as error:
            self._carry_out(error.actions)
            raise WordError(f"{self._place((error.line,), 1)}: {error}") from None
        return Lines(made.text, self._carry_out(made.actions), lambda line: self._place(made.lines, line))

    def _carry_out(self, actions: Actions) -> tuple[str, ...]:
        """Call the clients that ACTIONS name; return what is to be shown."""
        replies: list[str] = []
        for action in actions:
            match action:
                case ("respond", str(text)):
                    replies.append(text)
                case ("call", str(method), dict(values)):
                    if not self._status.call_remote(method, values):
                        replies.append(
                            f"the remote method {method} was not called: no client has registered one"
                        )
        return tuple(replies)

    def _place(self, lines: tuple[int, ...], line: int) -> str:
        """Name where LINE of a rendered text comes from."""
        number = line_of(self._numbers, line_of(lines, line))
        return f"{Place(self._path, number)}: [{self.section}]"


class GCodeMacro(Module):
    """One macro."""

    SPEC = SectionSpec(
        "A macro: the command NAME, in capitals, runs these lines of g-code",
        (GCODE, RENAME, DESCRIPTION),
        family=VARIABLE,
    )
    NAMED = True

    def __init__(self, build: Build) -> None:
        super().__init__(build)
        self.command = build.instance.upper()
        if not _is_command(self.command):
            raise ConfigError(
                build.place, f"[{build.name}] has no name that can be a command; give one of letters and _"
            )
        self._template = GCodeTemplate(build, GCODE)
        self.variables = {name: _first_value(build, name, raw.value) for name, raw in _family(build)}
        self._shown = {name: plain(value) for name, value in self.variables.items()}
        self.renamed = (build.find(RENAME) or "").upper()
        """The command that had its name before; empty: none."""
        if self.renamed and not _is_command(self.renamed):
            raise build.reader.bad(RENAME, "is no name that a command can have")
        help_ = " ".join(build.get(DESCRIPTION).split()) or "G-Code macro"
        build.replace_command(
            GCodeCommand(self.command, help_, self._read, while_printing=True), self.renamed
        )
        build.shared(Variables)

    def status(self) -> Mapping[str, Value]:
        """Report the variables."""
        return dict(self._shown)

    def set_variable(self, name: str, value: object) -> None:
        """Give the variable NAME, which there is, another VALUE."""
        self.variables[name] = value
        self._shown[name] = plain(value)

    def stands_for(self) -> Mapping[str, set[str]]:
        """Report which words its lines have."""
        return {self.command: words_in(self.text)}

    @property
    def text(self) -> str:
        """Its template, as it is written."""
        return self._template.text

    def _read(self, call: Call) -> Reading:
        values = {"params": parameters(call.command), "rawparams": call.command.text.strip()}
        return self._template.lines(call, {**self.variables, **values})


class Variables(Module):
    """SET_GCODE_VARIABLE, for all macros."""

    def __init__(self, build: Build) -> None:
        super().__init__(build)
        self._macros: dict[str, GCodeMacro] = {}
        build.add_command(
            "SET_GCODE_VARIABLE",
            "Set a variable of a macro: MACRO, VARIABLE, VALUE",
            self._set,
            while_printing=True,
        )

    def link(self, modules: Modules) -> None:
        """Find the macros."""
        self._macros = {macro.command: macro for macro in modules.of(GCodeMacro)}

    def _set(self, call: Call) -> Reading:
        words = call.command.parameters()
        for key in ("MACRO", "VARIABLE", "VALUE"):
            needed(call.command, words, key)
        macro = self._macros[one(call.command, words, "MACRO", self._macros)]
        name = words["VARIABLE"].lower()
        if name not in macro.variables:
            has = ", ".join(macro.variables) or "none"
            raise WordError(f"the macro {macro.command} has no variable {quoted(name)}; it has {has}")
        try:
            value = literal(words["VALUE"])
        except ValueError as problem:
            if "VALUE='" not in call.command.text.upper():
                raise WordError(f"VALUE of SET_GCODE_VARIABLE {problem}") from None
            value = words["VALUE"]  # 'a text', whose quotes the parameters have lost

        def act() -> None:
            macro.set_variable(name, value)

        return Immediate(act=act)


def words_in(text: str) -> set[str]:
    """Return what may be names of commands in TEXT, in capitals."""
    return {word.upper() for word in _NAMES.findall(text)}


def parameters(command: Command) -> dict[str, str]:
    """Return what a macro gets as ``params``; raises WordError."""
    if not _is_code(command.name):
        return command.parameters()
    try:
        return command.words()
    except WordError:
        try:
            return command.parameters()
        except WordError:
            return {}  # free text, as behind M117


def literal(text: str) -> Any:
    """Return the value that TEXT writes as Python does; raises ValueError: the end of a sentence."""
    if len(text) > VALUE_MAX:
        raise ValueError(f"is longer than {VALUE_MAX} characters")
    try:
        value = ast.literal_eval(text)
    except (ValueError, SyntaxError, TypeError, RecursionError, MemoryError):
        value = ...
    if any(abs(number) > INTEGER_MAX for number in _integers(value)):
        raise ValueError(f"has a whole number beyond {INTEGER_MAX}; write it as a text, or with a point")
    if not _can_be_kept(value):
        raise ValueError(
            f"is {quoted(text)}, which is no value: write 1, 0.5, True, 'text', [1, 2] or {{'a': 1}}"
        )
    return value


def _can_be_kept(value: object) -> bool:
    """Return whether VALUE reads as itself once it is written; numbers that are not finite do not."""
    if isinstance(value, float):
        return math.isfinite(value)
    if isinstance(value, dict):
        return all(_can_be_kept(each) for pair in value.items() for each in pair)
    if isinstance(value, list | tuple | set):
        return all(map(_can_be_kept, value))
    return value is None or isinstance(value, bool | int | str)


def _integers(value: object) -> Iterator[int]:
    """Return the whole numbers in VALUE."""
    if isinstance(value, int):
        yield value
    elif isinstance(value, dict):
        for pair in value.items():
            yield from _integers(pair)
    elif isinstance(value, list | tuple | set):
        for inner in value:
            yield from _integers(inner)


def plain(value: object) -> Value:
    """Return VALUE of what a status may hold."""
    if value is None or isinstance(value, bool | int | float | str):
        return value
    if isinstance(value, dict):
        return {str(key): plain(inner) for key, inner in value.items()}
    if isinstance(value, list | tuple | set):
        return [plain(inner) for inner in value]
    return str(value)


def _family(build: Build) -> list[tuple[str, Any]]:
    return list(build.reader.family().items())


def _first_value(build: Build, name: str, text: str) -> object:
    try:
        return literal(text)
    except ValueError as problem:
        place = build.reader.section.options[f"{VARIABLE.name}{name}"].place
        raise ConfigError(place, f"option 'variable_{name}' of [{build.name}] {problem}") from None


def _is_code(name: str) -> bool:
    return name[:1] in "GMT" and name[1:2].isdigit()


def _is_command(name: str) -> bool:
    try:
        command = parse(name.encode())
    except WordError:
        return False
    return command is not None and name in (command.name, command.written) and not command.text
