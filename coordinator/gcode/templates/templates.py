"""G-code templates: text of the configuration that becomes lines of g-code when it is called.

Jinja2 with ``{`` and ``}`` around values. A template is checked here, and rendered in another process
(renderer.py), which starts with the first one that has to be.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache, lru_cache
from typing import TYPE_CHECKING, Any, Final

from coordinator.gcode.templates.renderer import Actions, RenderingFailed, template_renderer
from nodes.support.errors import CanductorError

if TYPE_CHECKING:
    from coordinator.gcode.templates.sandbox import Sandbox

_NOTHING: Final[Mapping[str, Any]] = {}


class TemplateError(CanductorError):
    """A template that is wrong, or went wrong; LINE of its text, from 1; ACTIONS: what it asked for."""

    def __init__(self, line: int, problem: str, actions: Actions = ()) -> None:
        super().__init__(problem)
        self.line = line
        self.actions = actions


class Asked(Exception):  # noqa: N818 (an end that a template asks for)
    """A template ends itself: ``action_raise_error``, ``action_emergency_stop``, after ACTIONS."""

    def __init__(self, text: str, actions: Actions = (), *, emergency: bool = False) -> None:
        super().__init__(text)
        self.actions = actions
        self.emergency = emergency


@dataclass(frozen=True, slots=True)
class Rendered:
    """What a template made."""

    text: str
    lines: tuple[int, ...]
    """For each line of the text: the template's line it comes from."""
    actions: Actions = ()
    """What it asked for besides, in order: ("respond", text), ("call", method, values)."""


class Template:
    """TEXT, checked; raises TemplateError. Texts without ``{`` are what they are."""

    def __init__(self, text: str) -> None:
        self.text = text
        self.plain = "{" not in text
        """Whether there is nothing to render."""
        if not self.plain:
            _check(text)

    def render(self, values: Mapping[str, object], printer: Mapping[str, Any] = _NOTHING) -> Rendered:
        """Make the text with VALUES and PRINTER, whose values are looked at only if the template does.

        Raises TemplateError, and Asked when the template ends itself.
        """
        if self.plain:
            return Rendered(self.text, tuple(range(1, self.text.count("\n") + 2)))
        try:
            answer = template_renderer().render(self.text, values, printer)
        except RenderingFailed as failed:
            raise TemplateError(failed.line, str(failed), failed.actions) from None
        if answer.end is not None:
            raise Asked(answer.end, answer.actions, emergency=answer.emergency)
        return Rendered(answer.text, answer.lines, answer.actions)


@lru_cache(maxsize=1000)
def _check(text: str) -> None:
    from jinja2 import TemplateSyntaxError  # noqa: PLC0415 (4 MB, for machines with templates)

    try:
        _sandbox().prepared(text)
    except TemplateSyntaxError as error:
        raise TemplateError(error.lineno, error.message or "cannot be read") from None
    except RecursionError:
        raise TemplateError(1, "it is nested too deeply") from None


@cache
def _sandbox() -> "Sandbox":
    from coordinator.gcode.templates.sandbox import Sandbox  # noqa: PLC0415 (imports jinja2)

    return Sandbox()


def line_of(numbers: Sequence[int], line: int) -> int:
    """Return the entry of NUMBERS for LINE, from 1; that of the last where there are too few."""
    return numbers[min(line, len(numbers)) - 1] if numbers else 0
