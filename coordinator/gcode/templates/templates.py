"""G-code templates: text of the configuration that becomes lines of g-code when it is called.

Jinja2 with ``{`` and ``}`` around values. It is loaded when the first template is met, not before: most plans
need none, and it takes longer to load than they take to begin.
"""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache, lru_cache
from typing import Any, Final

import jinja2
from jinja2 import TemplateSyntaxError, nodes

from coordinator.gcode.templates.sandbox import Meter, Sandbox, TooMuch
from nodes.support.errors import CanductorError

_FILE: Final = "<g-code template>"
_MARK = re.compile("\x1e(\\d+)\x1f")
_MARKABLE: Final = ("Template", "For", "If", "Scope", "Output")
"""Parts of a tree whose text goes straight to the output."""


class TemplateError(CanductorError):
    """A template that is wrong, or went wrong; LINE of its text, from 1."""

    def __init__(self, line: int, problem: str) -> None:
        super().__init__(problem)
        self.line = line


class Asked(Exception):  # noqa: N818 (an end that a template asks for)
    """A template ends itself: ``action_raise_error``, ``action_emergency_stop``."""

    def __init__(self, text: str, *, emergency: bool = False) -> None:
        super().__init__(text)
        self.emergency = emergency


@dataclass(frozen=True, slots=True)
class Rendered:
    """What a template made."""

    text: str
    lines: tuple[int, ...]
    """For each line of the text: the template's line it comes from."""


class Template:
    """TEXT, checked; raises TemplateError. Texts without ``{`` are what they are."""

    def __init__(self, text: str) -> None:
        self.text = text
        self._plain = "{" not in text
        if not self._plain:
            _check(text)

    def render(self, values: Mapping[str, object]) -> Rendered:
        """Make the text with VALUES; raises TemplateError, and Asked when the template says so."""
        if self._plain:
            return Rendered(self.text, tuple(range(1, self.text.count("\n") + 2)))
        compiled = _compile(self.text)
        return _without_marks("".join(_pieces(compiled, values)))


def _pieces(compiled: "jinja2.Template", values: Mapping[str, object]) -> list[str]:
    sandbox = _sandbox()
    sandbox.meter = meter = Meter()
    pieces: list[str] = []
    try:
        for piece in compiled.generate(dict(values)):
            meter.text(len(piece))
            pieces.append(piece)
    except Asked:
        raise
    except TooMuch as error:
        raise TemplateError(_line_of(error), str(error)) from None
    except RecursionError as error:
        raise TemplateError(_line_of(error), "a macro of the template calls itself without end") from None
    # Whatever goes wrong in the user's text is the user's to read: the sandbox lets nothing else happen.
    except Exception as error:  # noqa: BLE001
        raise TemplateError(_line_of(error), _sentence(error)) from None
    finally:
        sandbox.meter = None
    return pieces


def _sentence(error: Exception) -> str:
    text = " ".join(str(error).split()) or type(error).__name__
    return text if len(text) <= 200 else text[:200] + "..."


def _line_of(error: BaseException) -> int:
    """Return the template's line at which ERROR came up; Jinja2 has put it into the traceback."""
    line, trace = 1, error.__traceback__
    while trace is not None:
        if trace.tb_frame.f_code.co_filename == _FILE:
            line = trace.tb_lineno
        trace = trace.tb_next
    return line


@lru_cache(maxsize=1000)
def _check(text: str) -> None:
    try:
        _sandbox().prepared(text)
    except TemplateSyntaxError as error:
        raise TemplateError(error.lineno, error.message or "cannot be read") from None


@lru_cache(maxsize=1000)
def _compile(text: str) -> "jinja2.Template":
    sandbox = _sandbox()
    tree = sandbox.prepared(text)
    _mark(tree)
    try:
        code = sandbox.compile(tree, name="template", filename=_FILE)
    except TemplateSyntaxError as error:
        raise TemplateError(error.lineno, error.message or "cannot be read") from None
    return sandbox.template_class.from_code(sandbox, code, dict(sandbox.globals))


@cache
def _sandbox() -> "Sandbox":
    return Sandbox()


# ---- Where a line comes from -----------------------------------------------------------------------------


def _mark(node: "nodes.Node") -> None:
    """Have every line of NODE's text begin with a mark that tells its number.

    Texts that a template keeps (``{% set %}`` blocks, macros) stay as they are: it may look at them.
    """
    for child in node.iter_child_nodes():
        kind = type(child).__name__
        if kind == "TemplateData":
            _mark_lines(child)
        elif kind in _MARKABLE:
            _mark(child)


def _mark_lines(data: Any) -> None:
    first, *others = data.data.split("\n")
    marked = [f"\x1e{data.lineno + k}\x1f{line}" for k, line in enumerate(others, 1)]
    data.data = "\n".join([first, *marked])


def _without_marks(text: str) -> Rendered:
    lines: list[str] = []
    numbers: list[int] = []
    for line in text.split("\n"):
        marks = _MARK.findall(line)
        numbers.append(int(marks[0]) if marks else numbers[-1] if numbers else 1)
        lines.append(_MARK.sub("", line) if marks else line)
    return Rendered("\n".join(lines), tuple(numbers))


def line_of(numbers: Sequence[int], line: int) -> int:
    """Return the entry of NUMBERS for LINE, from 1; that of the last where there are too few."""
    return numbers[min(line, len(numbers)) - 1] if numbers else 0
