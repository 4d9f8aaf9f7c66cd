"""Reads the parameters of modules' commands; mistakes are WordErrors."""

from collections.abc import Iterable, Mapping

from coordinator.gcode.words import Command, WordError, number, quoted
from coordinator.machine.problem import nearest


def numbers(command: Command, allowed: str) -> dict[str, float]:
    """Return COMMAND's letters, all with numbers and all of ALLOWED."""
    words = command.words()
    for letter in words:
        if letter not in allowed:
            raise WordError(f"{command.name} has the word {letter}; it takes {' '.join(allowed)}")
    return {letter: number(command.name, words, letter) for letter in words}


def parameters(command: Command, allowed: Iterable[str]) -> dict[str, str]:
    """Return COMMAND's NAME=VALUE, all of ALLOWED."""
    allowed = tuple(allowed)
    found = command.parameters()
    for name in found:
        if name not in allowed:
            hint = nearest(name, allowed) or f"; it takes {', '.join(allowed)}"
            raise WordError(f"{command.name} has no parameter {quoted(name)}{hint}")
    return found


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
        raise WordError(f"{command.name} needs {name}=; there is {', '.join(known)}")
    for name_ in known:
        if name_.lower() == text.lower():
            return name_
    hint = nearest(text, known) or f"; there is {', '.join(known)}"
    raise WordError(f"{command.name}: there is no {quoted(text)}{hint}")
