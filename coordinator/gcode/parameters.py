"""Reads the parameters of commands; every mistake is a WordError that says what to write."""

from collections.abc import Iterable, Mapping
from typing import TypeVar

from coordinator.gcode.parser import Command, WordError, number, quoted
from coordinator.support.quoting import nearest_or_all

T = TypeVar("T", float, None)


def numbers(command: Command, allowed: str) -> dict[str, float]:
    """Return COMMAND's letters of ALLOWED, all with numbers; others are ignored."""
    words = command.only_words(allowed)
    return {letter: number(command.name, words, letter) for letter in words}


def value(command: Command, given: Mapping[str, str], name: str, default: float | None = None) -> float:
    """Return the number of a parameter."""
    if name in given:
        return number(command.name, given, name)
    if default is None:
        raise WordError(f"{command.name} needs {name}=, a number")
    return default


def one(command: Command, given: Mapping[str, str], name: str, known: Iterable[str]) -> str:
    """Return the parameter that names one of KNOWN, as it stands there."""
    known = tuple(known)
    text = given.get(name)
    if text is None:
        raise WordError(f"{command.name} needs {name}=; there is {', '.join(known) or 'none'}")
    for name_ in known:
        if name_.lower() == text.lower():
            return name_
    hint = nearest_or_all(text, known)
    raise WordError(f"{command.name}: there is no {quoted(text)}{hint}")


def needed(command: Command, values: Mapping[str, str], key: str) -> str:
    """Return VALUES[KEY]."""
    if key not in values:
        raise WordError(f"{command.name} has no {key}; add {key}=...")
    return values[key]


def bounded(
    command: Command, values: Mapping[str, str], key: str, default: T, *, low: float, high: float
) -> float | T:
    """Read the number VALUES[KEY], from LOW to HIGH; without it, DEFAULT."""
    if key not in values:
        return default
    value = number(command.name, values, key)
    if not low <= value <= high:
        raise WordError(f"{key} of {command.name} is {value:g}; {low:g} to {high:g} are possible")
    return value


def flag(command: Command, values: Mapping[str, str], key: str) -> bool:
    """Read KEY=0 or KEY=1; without it, False."""
    text = values.get(key, "0")
    if text not in {"0", "1"}:
        raise WordError(f"{key} of {command.name} is {quoted(text)}; give 0 or 1")
    return text == "1"
