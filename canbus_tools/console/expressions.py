"""Arithmetic for the console: numbers, durations, and clocks of a node, exactly and within bounds.

``clock+50ms``, ``3*freq/1000``, ``max(100us, 2*freq//250000)``. Python's own parser reads it; of what it can
say only the arithmetic below is known here, and nothing is ever executed.

A clock on the wire has 32 bits and goes round, a duration does not. So every value knows how often it has a
clock in it: ``clock+2s`` once, ``clock-start`` not at all. Only the former may leave 32 bits, and goes round.
"""

import ast
import re
import warnings
from collections.abc import Callable, Mapping
from fractions import Fraction
from typing import Final, NamedTuple

from nodes.support.errors import CanductorError

TEXT_MAX: Final = 200
"""Characters of an expression."""
BITS_MAX: Final = 256
"""Of numerator and denominator on the way; what is sent has 32."""
SHIFT_MAX: Final = 64
UNITS: Final[Mapping[str, Fraction]] = {
    "s": Fraction(1),
    "ms": Fraction(1, 1000),
    "us": Fraction(1, 1_000_000),
    "ns": Fraction(1, 1_000_000_000),
}
"""What a number can end in, in seconds."""
_DURATION: Final = re.compile(r"(?<![\w.])([0-9]+(?:\.[0-9]*)?|\.[0-9]+)(s|ms|us|ns)\b")
_NAME: Final = re.compile(r"[A-Za-z_]\w*")
_WHOLE: Final = 1 << 32
_HALF: Final = 1 << 31


class ExpressionError(CanductorError):
    """An expression cannot be read, or has no value."""


class Quantity(NamedTuple):
    """A number, and how often a clock is part of it."""

    value: Fraction
    clocks: int = 0

    @classmethod
    def clock(cls, ticks: int) -> "Quantity":
        """Return a moment on a node's clock."""
        return cls(Fraction(ticks), 1)

    def whole(self) -> int:
        """Return the nearest whole number; of two as near, the even one."""
        return round(self.value)

    def for_range(self, low: int, high: int) -> int:
        """Return the whole number as a parameter from LOW to HIGH takes it: a clock goes round in 32 bits."""
        whole = self.whole()
        if self.clocks == 1 and not low <= whole <= high:
            whole %= _WHOLE
            return whole - _WHOLE if whole > high and low == -_HALF else whole
        return whole


def is_name(text: str) -> bool:
    """Return whether TEXT is a valid name in an expression."""
    return bool(_NAME.fullmatch(text)) and text not in UNITS and text not in _FUNCTIONS


def names_in(text: str) -> set[str]:
    """Return all that TEXT may refer to, whether or not it is an expression."""
    return set(_NAME.findall(_DURATION.sub("0", text)))


def evaluate(text: str, names: Mapping[str, Quantity], freq_hz: int | None = None) -> Quantity:
    """Return the value of TEXT; a duration such as ``50ms`` counts in ticks of FREQ_HZ. ExpressionError."""
    shown = " ".join(text.split())
    if not shown or len(text) > TEXT_MAX:
        length = f"has {len(text)} characters, at most {TEXT_MAX} are read" if shown else "is empty"
        raise ExpressionError(f"the expression {length}")
    if freq_hz is None and (found := _DURATION.search(text)):
        raise ExpressionError(f"'{found[0]}' is a time, and the node does not say how fast its clock is")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")  # what Python only doubts is no expression here
            tree = ast.parse(_DURATION.sub(r"(\1*__\2)", text.strip()), mode="eval")
    except (SyntaxError, ValueError, MemoryError, RecursionError):
        raise ExpressionError(
            f"'{shown}' is no expression; write numbers, times (50ms), names, + - * / // % << >> & | ^ ( )"
        ) from None
    units = {f"__{unit}": Quantity(in_s * (freq_hz or 0)) for unit, in_s in UNITS.items()}
    try:
        return _Reader({**names, **units}).read(tree.body)
    except ExpressionError as error:
        raise ExpressionError(f"'{shown}': {error}") from None


class _Reader:
    def __init__(self, names: Mapping[str, Quantity]) -> None:
        self._names = names

    def read(self, node: ast.expr) -> Quantity:
        result = self._read(node)
        value = result.value
        if max(value.numerator.bit_length(), value.denominator.bit_length()) > BITS_MAX:
            raise ExpressionError("a number in it gets too long")
        return result

    def _read(self, node: ast.expr) -> Quantity:
        if isinstance(node, ast.Constant):
            return _number(node.value)
        if isinstance(node, ast.Name):
            return self._named(node.id)
        if isinstance(node, ast.UnaryOp):
            return _one(node.op, self.read(node.operand))
        if isinstance(node, ast.BinOp):
            return _two(node.op, self.read(node.left), self.read(node.right))
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and not node.keywords:
            return _call(node.func.id, [self.read(argument) for argument in node.args])
        raise ExpressionError("only + - * / // % << >> & | ^ ~ ( ) and min, max, abs, round, floor, ceil")

    def _named(self, name: str) -> Quantity:
        if name in self._names:
            return self._names[name]
        known = ", ".join(sorted(known for known in self._names if not known.startswith("__")))
        raise ExpressionError(f"nothing is called '{name}'; there are {known or 'no names'}")


def _number(value: object) -> Quantity:
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise ExpressionError(f"{value!r} is not a number")
    try:
        return Quantity(Fraction(repr(value)) if isinstance(value, float) else Fraction(value))
    except ValueError:
        raise ExpressionError("a number in it gets too long") from None


def _one(operation: ast.unaryop, of: Quantity) -> Quantity:
    if isinstance(operation, ast.USub):
        return Quantity(-of.value, -of.clocks)
    if isinstance(operation, ast.UAdd):
        return of
    if isinstance(operation, ast.Invert):
        return Quantity(Fraction(~_integer(of, "~")))
    raise ExpressionError("'not' is no arithmetic")


def _two(operation: ast.operator, left: Quantity, right: Quantity) -> Quantity:
    if isinstance(operation, ast.Add):
        return Quantity(left.value + right.value, left.clocks + right.clocks)
    if isinstance(operation, ast.Sub):
        return Quantity(left.value - right.value, left.clocks - right.clocks)
    found = _OPERATIONS.get(type(operation))
    if found is None:
        raise ExpressionError("'**' and '@' are not known")
    sign, act = found
    if sign in {"/", "//", "%"} and not right.value:
        raise ExpressionError("divides by zero")
    if sign in {"*", "/", "//", "%"}:
        return Quantity(act(left.value, right.value))
    a, b = _integer(left, sign), _integer(right, sign)
    if sign in {"<<", ">>"} and not 0 <= b <= SHIFT_MAX:
        raise ExpressionError(f"shifts by {b}, must be 0 to {SHIFT_MAX}")
    return Quantity(Fraction(act(a, b)))


def _integer(of: Quantity, sign: str) -> int:
    if of.value.denominator != 1:
        raise ExpressionError(f"{sign} takes whole numbers, not {float(of.value):g}; divide with //")
    return of.value.numerator


_OPERATIONS: Final[Mapping[type[ast.operator], tuple[str, Callable[..., Fraction]]]] = {
    ast.Mult: ("*", lambda a, b: a * b),
    ast.Div: ("/", lambda a, b: a / b),
    ast.FloorDiv: ("//", lambda a, b: Fraction(a // b)),
    ast.Mod: ("%", lambda a, b: a % b),
    ast.LShift: ("<<", lambda a, b: a << b),
    ast.RShift: (">>", lambda a, b: a >> b),
    ast.BitAnd: ("&", lambda a, b: a & b),
    ast.BitOr: ("|", lambda a, b: a | b),
    ast.BitXor: ("^", lambda a, b: a ^ b),
}


def _call(name: str, of: list[Quantity]) -> Quantity:
    if name not in _FUNCTIONS:
        raise ExpressionError(f"there is no function '{name}'; there are {', '.join(_FUNCTIONS)}")
    least, act = _FUNCTIONS[name]
    if len(of) < least or (least == 1 and len(of) > 1):
        raise ExpressionError(f"{name} takes {'one value' if least == 1 else 'two or more values'}")
    return act(of)


_FUNCTIONS: Final[Mapping[str, tuple[int, Callable[[list[Quantity]], Quantity]]]] = {
    "min": (2, min),
    "max": (2, max),
    "abs": (1, lambda of: Quantity(abs(of[0].value))),
    "round": (1, lambda of: Quantity(Fraction(round(of[0].value)), of[0].clocks)),
    "floor": (1, lambda of: Quantity(Fraction(of[0].value // 1), of[0].clocks)),
    "ceil": (1, lambda of: Quantity(Fraction(-(-of[0].value // 1)), of[0].clocks)),
}
"""By name: the least number of values (1: exactly one) and the function."""
