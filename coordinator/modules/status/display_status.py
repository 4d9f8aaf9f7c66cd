"""[display_status]: the message and progress that programs set: M117, SET_DISPLAY_TEXT, M73."""

from collections.abc import Mapping
from typing import Final

from coordinator.config.options import SectionSpec
from coordinator.gcode.commands import Call, Immediate, Reading
from coordinator.gcode.parser import WordError, number
from coordinator.modules.base import Build, Module
from coordinator.support.values import Value

TEXT_MAX: Final = 500
"""Characters of a message."""


class DisplayStatus(Module):
    """A message, and the progress that the program reports."""

    SPEC = SectionSpec("The message (M117) and progress (M73) that programs set", ())

    def __init__(self, build: Build) -> None:
        super().__init__(build)
        self._message: str | None = None
        self._progress: float | None = None
        for name, help_, read in (
            ("M117", "Show a message", self._show),
            ("SET_DISPLAY_TEXT", "Show MSG; without it, clear the message", self._set),
            ("M73", "Set the progress of the program: P, percent", self._set_progress),
        ):
            build.add_command(name, help_, read, while_printing=True)

    def status(self) -> Mapping[str, Value]:
        """Report the message, and the progress of 0 to 1; None: not set."""
        return {"message": self._message, "progress": self._progress}

    def job_begins(self) -> None:
        """Forget how far another program was."""
        self._progress = None

    def _show(self, call: Call) -> Reading:
        return self._message_is(call.command.text.strip())

    def _set(self, call: Call) -> Reading:
        return self._message_is(call.parameters("MSG").get("MSG", ""))

    def _message_is(self, text: str) -> Reading:
        def act() -> None:
            self._message = text[:TEXT_MAX] or None

        return Immediate(act=act)

    def _set_progress(self, call: Call) -> Reading:
        words = call.command.words("PQRS")
        if "P" not in words:
            return Immediate()  # R alone: the minutes that are left
        percent = number("M73", words, "P")
        if not 0 <= percent <= 100:
            raise WordError(f"P of M73 is {percent:g} %; 0 to 100 % are possible")

        def act() -> None:
            self._progress = percent / 100

        return Immediate(act=act)
