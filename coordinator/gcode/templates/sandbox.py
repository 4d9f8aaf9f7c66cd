"""What a template may do: Jinja2's sandbox, with bounds on its time and on all that it makes.

A template comes from the user's own configuration, but a mistake in it must not stop a machine that prints:
every turn of a loop and every call is counted, and nothing it builds may grow beyond MAX_CHARS. Operations
that could make something huge in a single step are looked at before they are done. These bounds give a
sentence with the template's line; what they miss ends at the limits of the process (worker.py, renderer.py).
"""

import functools
import pprint
import re
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import Any, Final

from jinja2 import TemplateSyntaxError, nodes, pass_context
from jinja2.runtime import Context
from jinja2.sandbox import SandboxedEnvironment
from jinja2.visitor import NodeTransformer

MAX_TURNS: Final = 100_000
"""Turns of loops and calls of one rendering."""
MAX_CHARS: Final = 1_000_000
"""Of what is rendered, and of anything a template builds."""
MAX_CPU_S: Final = 0.2
"""Time of the processor after which a rendering ends itself, with the line where it was. What does not count
its steps (one call that takes long) is ended from outside, a little later (renderer.py)."""
MAX_WIDTH: Final = 10_000
"""Of padding, indentation and the like."""
_MAX_BITS: Final = 4096
_CHECKED_TURNS: Final = 64
"""The clock is read every so many turns."""
_WIDE = re.compile(r"\d{5}|\{[^{}]*\{|\*")
"""In what formats a text: a width of five digits, or one that comes from elsewhere."""
_PADDING = frozenset(("center", "ljust", "rjust", "zfill", "expandtabs"))
_WITH_WIDTH = ("batch", "center", "indent", "slice", "tojson", "truncate", "wordwrap")
_USELESS = ("urlize", "xmlattr")


class TooMuch(Exception):  # noqa: N818 (shown to the user as a sentence)
    """A template goes beyond its bounds."""


class Meter:
    """Counts what one rendering takes."""

    def __init__(self) -> None:
        self._turns = 0
        self._chars = 0
        self._until_s = time.thread_time() + MAX_CPU_S

    def turn(self, count: int = 1) -> None:
        """Count turns of loops, or calls."""
        before, self._turns = self._turns, self._turns + count
        if self._turns > MAX_TURNS:
            raise TooMuch(f"more than {MAX_TURNS} turns of loops and calls; does a loop not end?")
        if before // _CHECKED_TURNS != self._turns // _CHECKED_TURNS and time.thread_time() > self._until_s:
            raise TooMuch(f"it takes more than {MAX_CPU_S:g} s of processor time; have it do less")

    def text(self, chars: int) -> None:
        """Count characters that are rendered."""
        self._chars += chars
        if self._chars > MAX_CHARS:
            raise TooMuch(f"it makes more than {MAX_CHARS} characters; does a loop not end?")


def _check_size(size: int) -> None:
    if size > MAX_CHARS:
        raise TooMuch(f"a text or a list of more than {MAX_CHARS} parts")


def _check_format(text: object, values: Iterable[object]) -> None:
    """Refuse widths that are huge, or come from values that are."""
    if isinstance(text, str) and (found := _WIDE.search(text)):
        if found[0].isdigit() or any(isinstance(v, int) and abs(v) > MAX_WIDTH for v in values):
            raise TooMuch(f"a format whose width is above {MAX_WIDTH}")
        _check_size(len(text))


def _check_replace(text: object, values: tuple[object, ...]) -> None:
    if isinstance(text, str) and len(values) > 1:
        _check_size((len(text) + 1) * max(1, len(str(values[1]))))


def _check_widths(values: Iterable[object]) -> None:
    if any(isinstance(value, int) and abs(value) > MAX_WIDTH for value in values):
        raise TooMuch(f"a width above {MAX_WIDTH}")


def _size(value: object) -> int:
    return len(value) if isinstance(value, str | list | tuple | bytes) else 0


class Sandbox(SandboxedEnvironment):
    """Compiles templates, ``{`` value ``}`` and ``{%`` statement ``%}``, and runs them within bounds."""

    intercepted_binops = frozenset(("+", "*", "**", "%"))

    def __init__(self) -> None:
        super().__init__(
            block_start_string="{%",
            block_end_string="%}",
            variable_start_string="{",
            variable_end_string="}",
            keep_trailing_newline=True,
            finalize=self._output,
            extensions=["jinja2.ext.do"],
            cache_size=0,
            optimized=False,  # nothing of a template is calculated while it is compiled
        )
        self._of_thread = threading.local()
        self.globals.pop("lipsum", None)
        for name in _USELESS:
            self.filters.pop(name, None)
        for name in _WITH_WIDTH:
            self.filters[name] = _narrow(self.filters[name])
        self.filters["format"] = _formatted
        self.filters["replace"] = _replaced
        self.filters["join"] = _joined
        self.filters["pprint"] = _printed
        self.filters["turns"] = self._turns
        self.filters["concatenated"] = _concatenated

    @property
    def meter(self) -> Meter | None:
        """That of the rendering that goes on in this thread."""
        return getattr(self._of_thread, "meter", None)

    @meter.setter
    def meter(self, meter: Meter | None) -> None:
        self._of_thread.meter = meter

    def prepared(self, text: str) -> nodes.Template:
        """Return TEXT as a tree whose loops count; raises TemplateSyntaxError."""
        tree = self.parse(text)
        for found in tree.find_all((nodes.Filter, nodes.Test)):
            known = self.filters if isinstance(found, nodes.Filter) else self.tests
            if found.name not in known:
                what = type(found).__name__.lower()
                raise TemplateSyntaxError(f"there is no {what} {found.name!r}", found.lineno)
        counted = _Counted().visit(tree)
        assert isinstance(counted, nodes.Template)
        return counted

    def call(self, context: Context, obj: Any, /, *args: Any, **kwargs: Any) -> Any:
        """Call OBJ from within a template."""
        if self.meter is not None:
            self.meter.turn()
        method = getattr(obj, "__wrapped__", obj)
        owner, name = getattr(method, "__self__", None), getattr(method, "__name__", "")
        if isinstance(owner, str):
            if name in _PADDING:
                _check_widths(args)
            elif name in ("format", "format_map"):
                _check_format(owner, [*args, *kwargs.values(), *(_values(args) if "map" in name else ())])
            elif name == "replace":
                _check_replace(owner, args)
            elif name == "join":
                args = (_parts(owner, args[0]),) if len(args) == 1 else args
        result = super().call(context, obj, *args, **kwargs)
        _check_size(_size(result))
        return result

    def call_binop(self, context: Context, operator: str, left: Any, right: Any) -> Any:
        """Calculate, unless the result would be huge."""
        if operator == "+":
            _check_size(_size(left) + _size(right))
        elif operator == "%":
            _check_format(left, right if isinstance(right, tuple) else (right,))
        elif isinstance(left, int) and isinstance(right, int):
            bits = left.bit_length() * (abs(right) if operator == "**" else 1)
            if (bits if operator == "**" else bits + right.bit_length()) > _MAX_BITS:
                raise TooMuch("a number of more than 1,200 digits")
        elif operator == "*":
            for part, times in ((left, right), (right, left)):
                _check_size(_size(part) * (times if isinstance(times, int) else 0))
        return super().call_binop(context, operator, left, right)

    @pass_context
    def _output(self, _context: Context, value: object) -> str:
        text = str(value)
        if self.meter is not None:
            self.meter.text(len(text))
        return text

    def _turns(self, items: Iterable[object]) -> Iterable[object]:
        """Count the turns of a loop over ITEMS."""
        meter = self.meter
        if meter is None:
            return items
        if isinstance(items, list | tuple | dict | range | str):
            meter.turn(len(items))
            return items
        return _counted(items, meter)


def _printed(value: object) -> str:
    """Return VALUE over several lines, for reading."""
    text = pprint.pformat(value)
    _check_size(len(text))
    return text


def _counted(items: Iterable[object], meter: Meter) -> Iterator[object]:
    for item in items:
        meter.turn()
        yield item


class _Counted(NodeTransformer):
    """Has each loop's items, and each ``~``, go through a filter that counts."""

    def visit_For(self, node: nodes.For) -> nodes.Node:  # noqa: N802
        self.generic_visit(node)
        node.iter = nodes.Filter(node.iter, "turns", [], [], None, None, lineno=node.lineno)
        return node

    def visit_Concat(self, node: nodes.Concat) -> nodes.Node:  # noqa: N802
        self.generic_visit(node)
        parts = nodes.List(node.nodes, lineno=node.lineno)
        return nodes.Filter(parts, "concatenated", [], [], None, None, lineno=node.lineno)


def _values(args: tuple[object, ...]) -> list[object]:
    return [v for a in args if isinstance(a, Mapping) for v in a.values()]


def _parts(between: str, items: Iterable[object]) -> list[str]:
    parts: list[str] = []
    size = 0
    for item in items:
        parts.append(str(item))
        size += len(parts[-1]) + len(between)
        _check_size(size)
    return parts


def _concatenated(parts: list[object]) -> str:
    return "".join(_parts("", parts))


def _joined(items: Iterable[Any], between: str = "", attribute: str | None = None) -> str:
    if attribute is not None:
        items = [item.get(attribute, "") if isinstance(item, Mapping) else "" for item in items]
    return str(between).join(_parts(str(between), items))


def _formatted(text: object, *values: object, **named: object) -> str:
    _check_format(str(text), [*values, *named.values()])
    return str(text) % (named or values)


def _replaced(text: object, old: str, new: str, count: int = -1) -> str:
    _check_replace(str(text), (old, new))
    return str(text).replace(str(old), str(new), count)


def _narrow(plain: Callable[..., Any]) -> Callable[..., Any]:
    """Return a filter that refuses huge widths; it keeps what Jinja2 notes at it."""

    @functools.wraps(plain)
    def narrow(*args: Any, **named: Any) -> Any:
        _check_widths((*args, *named.values()))
        result = plain(*args, **named)
        _check_size(_size(result))
        return result

    return narrow
