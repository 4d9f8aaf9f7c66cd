"""[save_variables]: variables that survive a restart, in a file of their own.

The file is written by a thread, so that neither programs nor the control loop wait for a disk; atomically, so
that a power cut leaves the old values or the new ones. What a slow disk does not have yet when the machine
is restarted is read from memory. A machine that is only planned keeps them in memory.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

from coordinator.config.errors import ConfigError
from coordinator.config.options import SectionSpec, TextOption
from coordinator.config.text import split_lines
from coordinator.gcode.commands import Call, Immediate, Reading
from coordinator.gcode.parameters import needed
from coordinator.gcode.parser import WordError, quoted
from coordinator.modules.base import Build, Module, Modules
from coordinator.modules.programs.gcode_macro import literal, plain
from coordinator.support.file_writer import FileWriter
from coordinator.support.quoting import shown_path
from coordinator.support.values import Value
from nodes.support.errors import CanductorError
from nodes.support.regular_file import read_regular

FILENAME = TextOption(name="filename", help="The file, relative to that of the configuration; ~ is your home")
VARIABLES_MAX: Final = 1000
FILE_BYTES_MAX: Final = 1_000_000
_HEADER: Final = b"[Variables]\n"


class SaveVariables(Module):
    """The values, and the file that has them."""

    SPEC = SectionSpec("Variables that are kept in a file (SAVE_VARIABLE)", (FILENAME,))

    def __init__(self, build: Build) -> None:
        super().__init__(build)
        self.path = build.path(FILENAME)
        self._place = build.reader.place_of(FILENAME)
        self._lines: dict[str, bytes] = {}
        """Of the file, by variable."""
        self._shown: dict[str, Value] = {}
        """The values, as the status has them."""
        self._files = FileWriter()
        build.add_command(
            "SAVE_VARIABLE", "Save VALUE as VARIABLE in the file", self._save, while_printing=True
        )

    def link(self, modules: Modules) -> None:
        """Read the file; raises ConfigError."""
        self._files = modules.files
        try:
            unwritten = self._files.unwritten(self.path)
            found = read_variables(self.path) if unwritten is None else _variables_in(self.path, unwritten)
        except CanductorError as error:
            raise ConfigError(self._place, str(error)) from None
        self._lines = {name: _line(name, value) for name, value in found.items()}
        self._shown = {name: plain(value) for name, value in found.items()}

    def status(self) -> Mapping[str, Value]:
        """Report the values."""
        return {"variables": dict(self._shown)}

    def _save(self, call: Call) -> Reading:
        values = call.parameters("VARIABLE", "VALUE")
        name, text = (needed(call.command, values, key) for key in ("VARIABLE", "VALUE"))
        if not name.isidentifier() or not name.isascii():
            raise WordError(f"VARIABLE of SAVE_VARIABLE is {quoted(name)}; write letters, digits and _")
        name = name.lower()
        if name not in self._lines and len(self._lines) >= VARIABLES_MAX:
            raise WordError(f"{VARIABLES_MAX} variables are saved already; use one of their names again")
        try:
            value = literal(text)
        except ValueError as problem:
            if "VALUE='" not in call.command.text.upper():
                raise WordError(f"VALUE of SAVE_VARIABLE {problem}") from None
            value = text

        _check_readable(value)

        def act() -> None:
            lines = {**self._lines, name: _line(name, value)}
            if len(_HEADER) + sum(map(len, lines.values())) > FILE_BYTES_MAX:
                raise WordError(
                    f"the file of variables has no room for {name}: {FILE_BYTES_MAX:,} bytes at most"
                )
            self._lines = lines
            self._shown[name] = plain(value)
            if self._live is not None:
                data = _HEADER + b"".join(lines[each] for each in sorted(lines))
                self._files.write(self.path, data, self._fail)

        return Immediate(act=act)

    def _fail(self, error: OSError) -> None:
        """Report ERROR, in a thread that must not call whoever listens to notices."""
        live, reason = self.live, (error.strerror or str(error)).lower()
        sentence = f"the file of variables {shown_path(str(self.path))} cannot be written: {reason}"
        live.soon_on_loop(lambda: live.say(sentence))


def read_variables(path: Path) -> dict[str, Any]:
    """Return the values in the file PATH, none when there is no file; raises CanductorError."""
    try:
        data = read_regular(path, FILE_BYTES_MAX + 1)
    except FileNotFoundError:
        return {}
    except OSError as error:
        reason = (error.strerror or str(error)).lower()
        raise CanductorError(
            f"the file of variables {shown_path(str(path))} cannot be read: {reason}"
        ) from None
    if len(data) > FILE_BYTES_MAX:
        raise CanductorError(
            f"the file of variables {shown_path(str(path))} is larger than {FILE_BYTES_MAX} bytes"
        )
    return _variables_in(path, data)


def _variables_in(path: Path, data: bytes) -> dict[str, Any]:
    """Return the values in DATA, the content of the file PATH; raises CanductorError."""
    found: dict[str, Any] = {}
    for number, line in enumerate(split_lines(data, str(path)), 1):
        text = line.strip()
        if not text or text.startswith(("#", ";", "[")):
            continue
        name, equals, value = text.partition("=")
        if not equals:
            raise CanductorError(f"{path}:{number}: there is no = in this line; correct or remove it")
        try:
            found[name.strip().lower()] = literal(value.strip())
        except ValueError as problem:
            raise CanductorError(
                f"{path}:{number}: the value {problem}; correct or remove the line"
            ) from None
    return found


def _check_readable(value: object) -> None:
    """Raise WordError where VALUE, once it is written, would not be read again at the next start."""
    try:
        literal(repr(value))
    except ValueError as problem:
        raise WordError(f"VALUE of SAVE_VARIABLE, once it is written, {problem}") from None


def _line(name: str, value: object) -> bytes:
    return f"{name} = {value!r}\n".encode()
