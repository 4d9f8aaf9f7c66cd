"""Compiles and renders templates, in the process that does nothing else (worker.py).

Jinja2 with ``{`` and ``}`` around values, in the sandbox of sandbox.py.
"""

import re
from array import array
from collections.abc import Mapping
from typing import Any, Final

import jinja2
from jinja2 import TemplateSyntaxError, nodes

from coordinator.gcode.templates.sandbox import Meter, Sandbox, TooMuch

_FILE: Final = "<g-code template>"
_MARK = re.compile("\x1e(\\d+)\x1f")
_MARKABLE: Final = ("Template", "For", "If", "Scope", "Output")
"""Parts of a tree whose text goes straight to the output."""
SENTENCE_MAX: Final = 200
"""Characters of what goes wrong in a template."""
OUT_OF_MEMORY: Final = (MemoryError, SystemError)
"""Jinja2 compiles a few lines for the traceback of the former. Where there is no memory for that, either,
Python 3.13 raises the latter."""


class Failed(Exception):  # noqa: N818 (an answer to the user)
    """A template cannot be read, or went wrong at LINE of its text, from 1. MEMORY: it had too little."""

    def __init__(self, line: int, problem: str, *, memory: bool = False) -> None:
        super().__init__(problem)
        self.line = line
        self.memory = memory


class Ended(Exception):  # noqa: N818 (an end that a template asks for)
    """A template ends itself: ``action_raise_error``, ``action_emergency_stop``."""

    def __init__(self, text: str, *, emergency: bool = False) -> None:
        super().__init__(text)
        self.emergency = emergency


class TemplateCompiler:
    """Compiles templates for one sandbox."""

    def __init__(self) -> None:
        self.sandbox = Sandbox()

    def compile(self, text: str) -> "jinja2.Template":
        """Return TEXT compiled; raises Failed."""
        try:
            tree = self.sandbox.prepared(text)
            _mark(tree)
            code = self.sandbox.compile(tree, name="template", filename=_FILE)
        except TemplateSyntaxError as error:
            raise Failed(error.lineno, error.message or "cannot be read") from None
        except RecursionError:
            raise Failed(1, "it is nested too deeply") from None
        except OUT_OF_MEMORY:
            raise Failed(1, "it needs too much memory to be read", memory=True) from None
        return self.sandbox.template_class.from_code(self.sandbox, code, dict(self.sandbox.globals))

    def render(
        self, compiled: "jinja2.Template", values: Mapping[str, object], meter: Meter
    ) -> "tuple[str, array[int]]":
        """Return the text with VALUES and each line's number in the template; raises Failed and Ended."""
        self.sandbox.meter = meter
        try:
            return _without_marks("".join(_pieces(compiled, values, meter)))
        except Ended:
            raise
        except TooMuch as error:
            raise Failed(_line_of(error), str(error)) from None
        except RecursionError as error:
            raise Failed(_line_of(error), "a macro of the template calls itself without end") from None
        except OUT_OF_MEMORY as error:
            raise Failed(
                _line_of(error), "it needs too much memory; have it build less", memory=True
            ) from None
        # Whatever goes wrong in the user's text is the user's to read: the sandbox lets nothing else happen.
        except Exception as error:  # noqa: BLE001
            raise Failed(_line_of(error), _sentence(error)) from None
        finally:
            self.sandbox.meter = None


def _pieces(compiled: "jinja2.Template", values: Mapping[str, object], meter: Meter) -> list[str]:
    pieces: list[str] = []
    for piece in compiled.generate(dict(values)):
        meter.text(len(piece))
        pieces.append(piece)
    return pieces


def _sentence(error: Exception) -> str:
    text = " ".join(str(error)[: 4 * SENTENCE_MAX].split()) or type(error).__name__
    return text if len(text) <= SENTENCE_MAX else text[:SENTENCE_MAX] + "..."


def _line_of(error: BaseException) -> int:
    """Return the template's line at which ERROR came up; Jinja2 has put it into the traceback."""
    line, trace = 1, error.__traceback__
    while trace is not None:
        if trace.tb_frame.f_code.co_filename == _FILE:
            line = trace.tb_lineno
        trace = trace.tb_next
    return line


# ---- Where a line comes from -----------------------------------------------------------------------------


def _mark(node: "nodes.Node") -> None:
    """Have every line of NODE's text begin with a mark that contains its number.

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


def _without_marks(text: str) -> "tuple[str, array[int]]":
    lines: list[str] = []
    numbers = array("I")
    for line in text.split("\n"):
        marks = _MARK.findall(line)
        numbers.append(int(marks[0]) if marks else numbers[-1] if numbers else 1)
        lines.append(_MARK.sub("", line) if marks else line)
    return "\n".join(lines), numbers
