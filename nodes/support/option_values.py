"""Reading the values of command-line options, for every command line of the project."""

import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TypeVar

from nodes.support.errors import CanductorError

T = TypeVar("T")


class UsageError(Exception):
    """The words make no command; the sentence says why."""


def whole(option: str, text: str, low: int = 0, high: int | None = None) -> int:
    """Read a whole number from LOW to HIGH; raises UsageError."""
    digits = text.strip()
    number = int(digits) if digits.isascii() and digits.isdecimal() and len(digits) <= 20 else -1
    if number < low or (high is not None and number > high):
        bounds = f"of at least {low}" if high is None else f"from {low} to {high}"
        raise UsageError(f"{option} is '{text}', must be a whole number {bounds}")
    return number


def number(option: str, text: str, low: float, high: float, unit: str = "") -> float:
    """Read a number from LOW to HIGH; raises UsageError."""
    try:
        value = float(text)
    except ValueError:
        value = low - 1
    if not low <= value <= high:
        raise UsageError(
            f"{option} is '{text}', must be a number from {low:g} to {high:g}{unit and ' ' + unit}"
        )
    return value


def existing_file(path: Path | None) -> Path | None:
    """Return the path; raises CanductorError early when nothing can be read there."""
    if path is None:
        return None
    if not path.exists():
        raise CanductorError(f"there is no file '{path}'")
    if path.is_dir():
        raise CanductorError(f"'{path}' is a folder, not a file")
    if not os.access(path, os.R_OK):
        raise CanductorError(f"'{path}' may not be read; check its permissions")
    return path


def assignments(option: str, pairs: list[str] | None, convert: Callable[[str], T]) -> Mapping[str, T]:
    """Return the values of repeated NAME=VALUE options by name; raises UsageError."""
    result: dict[str, T] = {}
    for pair in pairs or ():
        name, equals, value = pair.partition("=")
        if not name or not equals or not value:
            raise UsageError(f"{option} takes NAME=VALUE, not '{pair}'")
        if name in result:
            raise UsageError(f"{option} is given twice for '{name}'")
        try:
            result[name] = convert(value)
        except ValueError as error:
            raise UsageError(f"{option} for '{name}' is '{value}', must be {error}") from None
    return result


def share(option: str, text: str, high: float = 0.5) -> float:
    """Read a share from 0 to HIGH, also written as a percentage; raises UsageError."""
    rule = f"a share from 0 to {high:g}, or a percentage such as 1%"
    try:
        value = float(text.removesuffix("%")) / (100 if text.endswith("%") else 1)
    except ValueError:
        value = -1.0
    if not 0 <= value <= high:
        raise UsageError(f"{option} is '{text}', must be {rule}")
    return value
