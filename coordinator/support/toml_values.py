"""Checked values of scenario files: frozen dataclasses are read from TOML tables by their own declarations.

A field says by ``option`` what it takes; ``read`` does the rest, and every mistake becomes one sentence that
names file, table and option. Where a seed may decide, an option takes a number or a range [low, high].
"""

import dataclasses
import random
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, TypeVar

from coordinator.support.quoting import nearest, shown
from nodes.support.errors import CanductorError

T = TypeVar("T")
Convert = Callable[[object], object]
"""Returns the checked value; raises ValueError with the rule that is broken."""


class ScenarioError(CanductorError):
    """A scenario that cannot be used; the sentence begins with its file."""


@dataclass(frozen=True, slots=True)
class Range:
    """What a seed draws from: all between LOW and HIGH, both included."""

    low: float
    high: float


class Dice:
    """Draws that depend on WORDS alone (scenario, seed), each on its own key: a new one leaves the others."""

    def __init__(self, *words: object) -> None:
        self._words = "/".join(map(str, words))

    def stream(self, key: str) -> random.Random:
        """Return the random numbers that belong to KEY."""
        return random.Random(f"{self._words}/{key}")  # noqa: S311 (a simulation, not a secret)

    def draw(self, span: Range, key: str) -> float:
        """Return the number of SPAN that belongs to KEY."""
        return span.low if span.low == span.high else self.stream(key).uniform(span.low, span.high)


# ---------------------------------------------------------------------------------------- kinds of values


def number(low: float, high: float, unit: str = "") -> Callable[[object], float]:
    """Take one number from LOW to HIGH."""

    def convert(value: object) -> float:
        if isinstance(value, bool) or not isinstance(value, int | float) or not low <= value <= high:
            raise ValueError(f"a number {_bounds(low, high, unit)}")
        return float(value)

    return convert


def span(low: float, high: float, unit: str = "") -> Convert:
    """Take a number, or a range [low, high] that the seed draws from."""
    one = number(low, high, unit)

    def convert(value: object) -> Range:
        ends = value if isinstance(value, list) else [value, value]
        try:
            begin, end = map(one, ends)
        except ValueError:
            begin, end = 1.0, 0.0
        if begin > end:
            raise ValueError(f"a number or a range [low, high] {_bounds(low, high, unit)}")
        return Range(begin, end)

    return convert


def whole(low: int, high: int) -> Convert:
    """Take one whole number from LOW to HIGH."""

    def convert(value: object) -> int:
        if isinstance(value, bool) or not isinstance(value, int) or not low <= value <= high:
            raise ValueError(f"a whole number {_bounds(low, high, '')}")
        return value

    return convert


def choice(*names: str) -> Convert:
    """Take one of NAMES."""

    def convert(value: object) -> str:
        if not isinstance(value, str) or value not in names:
            hint = nearest(value, names) if isinstance(value, str) else ""
            raise ValueError(f"one of {', '.join(names)}{hint}")
        return value

    return convert


def text(value: object) -> str:
    """Take a text that is not empty."""
    if not isinstance(value, str) or not value.strip():
        raise ValueError("a text")
    return value


def flag(value: object) -> bool:
    """Take true or false."""
    if not isinstance(value, bool):
        raise ValueError("true or false")  # noqa: TRY004 (every rule is reported by a ValueError)
    return value


def patterns(value: object) -> tuple[str, ...]:
    """Take a list of regular expressions."""
    if not isinstance(value, list) or not all(isinstance(entry, str) and entry for entry in value):
        raise ValueError("a list of regular expressions")
    for entry in value:
        try:
            re.compile(entry)
        except re.error as error:
            raise ValueError(f"a list of regular expressions; {shown(entry)} is none: {error}") from None
    return tuple(value)


def _bounds(low: float, high: float, unit: str) -> str:
    return f"from {low:g} to {high:g}{' ' if unit else ''}{unit}"


# ------------------------------------------------------------------------------------------------ reading

_CONVERT = "convert"


def option(convert: Convert, default: Any = dataclasses.MISSING) -> Any:
    """Declare a field of a table; without DEFAULT it must be given."""
    return dataclasses.field(default=default, metadata={_CONVERT: convert})


def read(kind: type[T], table: object, where: str) -> T:
    """Return the KIND (a dataclass of ``option`` fields) that TABLE describes; raises ScenarioError."""
    if not isinstance(table, Mapping):
        raise ScenarioError(f"{where} must be a table")
    assert dataclasses.is_dataclass(kind)
    fields = {field.name: field for field in dataclasses.fields(kind) if _CONVERT in field.metadata}
    for name in table:
        if name not in fields:
            hint = nearest(name, fields) or f"; it has {', '.join(sorted(fields))}"
            raise ScenarioError(f"{where}: there is no option {shown(name)}{hint}")
    values = {}
    for name, field in fields.items():
        if name in table:
            values[name] = _converted(field.metadata[_CONVERT], table[name], f"{where}: {name}")
        elif field.default is dataclasses.MISSING:
            raise ScenarioError(f"{where}: the option {name} is missing; add it")
    return kind(**values)


def _converted(convert: Convert, value: object, what: str) -> object:
    try:
        return convert(value)
    except ValueError as error:
        raise ScenarioError(f"{what} is {shown(str(value))}, must be {error}") from None
