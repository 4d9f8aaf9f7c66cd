"""Options of command lines: argparse with errors as exceptions, converters for ``type=``, option dataclasses.

A converter takes the text of a value and returns the value. It raises UsageError with a sentence without its
subject ("is 'x', must be ..."): ``Parser`` adds the option's name. For other callers NAME is the subject.
"""

import argparse
import dataclasses
import os
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NoReturn, TypeVar

from nodes.support.errors import CanductorError
from nodes.support.file_kind import exists, is_folder, is_regular
from nodes.support.numbers import read_decimal, read_int
from nodes.support.terminal import show

T = TypeVar("T")


class UsageError(Exception):
    """The command line is not valid; the sentence says why."""

    command = ""
    """The command with the error, such as "canductor run", once a Parser has set it."""


class ParserExit(Exception):  # noqa: N818 (no failure: --help or --version was given)
    """The parser has printed the requested help or version; exit."""


class Help(argparse.HelpFormatter):
    """Adds the default of an option to its help, unless the help contains it."""

    def _get_help_string(self, action: argparse.Action) -> str | None:
        text, default = action.help or "", action.default
        shown = isinstance(default, int | float | str | Path) and not isinstance(default, bool)
        if not shown or not action.option_strings or default == argparse.SUPPRESS or "(default" in text:
            return text
        value = f"{default:g}" if isinstance(default, float) else str(default)
        return f"{text} (default: {value.replace('%', '%%')})"


class Parser(argparse.ArgumentParser):
    """Raises UsageError and ParserExit where argparse prints and exits; refuses abbreviated options."""

    def __init__(self, **settings: Any) -> None:
        super().__init__(**{"allow_abbrev": False, "formatter_class": Help, **settings})

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> Any:
        """Parse as argparse does; an error names the innermost command that was parsed."""
        try:
            return super().parse_known_args(args, namespace)
        except UsageError as error:
            error.command = error.command or self.prog
            raise

    def error(self, message: str) -> NoReturn:
        """Raise UsageError."""
        raise UsageError(message)

    def _print_message(self, message: str, file: Any = None) -> None:
        show(message, file, end="")

    def exit(self, status: int = 0, message: str | None = None) -> NoReturn:
        """End after --help or --version."""
        del status, message
        raise ParserExit

    def _get_value(self, action: argparse.Action, arg_string: str) -> Any:
        try:
            return super()._get_value(action, arg_string)
        except UsageError as error:
            raise UsageError(f"{_name_of(action)} {error}") from None


def _name_of(action: argparse.Action) -> str:
    long = [option for option in action.option_strings if option.startswith("--")]
    return long[0] if long else str(action.metavar or action.dest)


class Assignments(argparse.Action):
    """Collects repeated pairs, converted by ``parse_assignment``, in a dictionary.

    EVERYTHING describes a pair without a name in messages.
    """

    def __init__(
        self, option_strings: Sequence[str], dest: str, *, everything: str = "all", **settings: Any
    ) -> None:
        super().__init__(option_strings, dest, **{"default": {}, **settings})
        self._everything = everything

    def __call__(
        self,
        parser: argparse.ArgumentParser,
        namespace: argparse.Namespace,
        values: Any,
        option_string: str | None = None,
    ) -> None:
        """Add a pair; raises UsageError for a name that was given before."""
        del parser
        name, value = values
        before = getattr(namespace, self.dest)
        if name in before:
            what = f"'{name}'" if name else self._everything
            raise UsageError(f"{option_string} is given twice for {what}")
        setattr(namespace, self.dest, {**before, name: value})


def parse_assignment(text: str, convert: Callable[[str], T]) -> tuple[str, T]:
    """Return the name of NAME=VALUE and the value, converted by CONVERT.

    CONVERT raises ValueError with a phrase that follows "must be", UsageError or CanductorError.
    """
    name, equals, value = text.partition("=")
    if not name or not equals or not value:
        raise UsageError(f"takes NAME=VALUE, not '{text}'")
    try:
        return name, convert(value)
    except ValueError as error:
        raise UsageError(f"for '{name}' is '{value}', must be {error}") from None


def parse_int(text: str, low: int = 0, high: int | None = None, *, name: str = "") -> int:
    """Return a whole number from LOW to HIGH; raises UsageError."""
    number = read_int(text.strip())
    if number is None or number < low or (high is not None and number > high):
        bounds = f"of at least {low}" if high is None else f"from {low} to {high}"
        raise _invalid(name, text, f"a whole number {bounds}")
    return number


def parse_hex(text: str, high: int, *, name: str = "") -> int:
    """Return a number from 0 to HIGH that may be written in hex, as in 0x1f; raises UsageError."""
    value = read_int(text, may_be_hex=True)
    if value is None or not 0 <= value <= high:
        raise _invalid(name, text, f"a number from 0 to {high:#x}")
    return value


def parse_float(text: str, low: float, high: float, unit: str = "", *, name: str = "") -> float:
    """Return a number from LOW to HIGH, in UNIT; raises UsageError."""
    value = read_decimal(text)
    if value is None or not low <= value <= high:
        raise _invalid(name, text, f"a number from {low:g} to {high:g}{unit and ' ' + unit}")
    return value


def integer(low: int = 0, high: int | None = None) -> Callable[[str], int]:
    """Return the converter ``parse_int`` with these bounds."""
    return partial(parse_int, low=low, high=high)


def decimal(low: float, high: float, unit: str = "") -> Callable[[str], float]:
    """Return the converter ``parse_float`` with these bounds."""
    return partial(parse_float, low=low, high=high, unit=unit)


def parse_ratio(text: str, high: float = 0.5, *, name: str = "") -> float:
    """Return a ratio from 0 to HIGH, also written as a percentage; raises UsageError."""
    value = read_decimal(text.removesuffix("%"))
    ratio = -1.0 if value is None else value / (100 if text.endswith("%") else 1)
    if not 0 <= ratio <= high:
        raise _invalid(name, text, f"a ratio from 0 to {high:g}, or a percentage such as 1%")
    return ratio


def parse_path(text: str, *suffixes: str) -> Path:
    """Return the path of a file to be written whose name ends in one of SUFFIXES; raises UsageError."""
    path = Path(text)
    if path.suffix.lower() not in suffixes:
        raise _invalid("", text, f"a file that ends in {' or '.join(suffixes)}")
    return path


def _invalid(name: str, text: str, rule: str) -> UsageError:
    return UsageError(f"{name} is '{text}', must be {rule}".lstrip())


def existing_file(path: str | Path) -> Path:
    """Return the path of a file that can be read; raises CanductorError."""
    path = Path(path)
    if not exists(path):
        raise CanductorError(f"there is no file '{path}'")
    if is_folder(path):
        raise CanductorError(f"'{path}' is a folder, not a file")
    if not os.access(path, os.R_OK):
        raise CanductorError(f"'{path}' may not be read; check its permissions")
    return path


def regular_file(path: str | Path) -> Path:
    """Return the path of a file that can be read, but of no pipe and no device; raises CanductorError."""
    path = existing_file(path)
    if not is_regular(path):
        raise CanductorError(f"'{path}' is not a regular file; save its content to one, and give that")
    return path


def add_command(
    commands: Any,
    name: str,
    summary: str,
    declare: Callable[[argparse.ArgumentParser], object],
    run: Callable[[argparse.Namespace], Any],
) -> None:
    """Add the command NAME to the subparsers COMMANDS.

    SUMMARY begins with a verb and has no full stop. DECLARE adds the options. RUN checks them, runs the
    command and returns its report; it raises UsageError or CanductorError.
    """
    command = commands.add_parser(name, **_summary(summary))
    declare(command)
    command.add_argument("--json", action="store_true", help="print one JSON object as the last line")
    command.set_defaults(run=run, command=command.prog)


def add_group(commands: Any, name: str, summary: str, metavar: str) -> Any:
    """Add the command NAME, which has commands of its own, and return its subparsers."""
    return commands.add_parser(name, **_summary(summary)).add_subparsers(
        title=f"{metavar.lower()}s", metavar=metavar, required=True
    )


def _summary(text: str) -> dict[str, str]:
    return {"help": text, "description": f"{text[0].upper()}{text[1:]}."}


def options_from(kind: type[T], given: argparse.Namespace, **computed: Any) -> T:
    """Return a dataclass KIND with fields from COMPUTED and, by name, from the options GIVEN."""
    names = {field.name for field in dataclasses.fields(kind)}  # type: ignore[arg-type]
    return kind(**{name: value for name, value in vars(given).items() if name in names} | computed)
