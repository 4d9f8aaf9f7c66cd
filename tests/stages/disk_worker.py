"""Writes durable files as the product does, with each call recorded, failing or killed (disk_calls.c).

A writer writes versions 1, 2, ... of what it keeps; version 0 is there before. Marks in the record say which
version was begun, and which is done as far as the caller knows. Each point gives a line of JSON.
"""

import asyncio
import ctypes
import errno
import json
import os
import shutil
import sys
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final

from coordinator.config.file import SAVED_HEADER, parse_saved
from coordinator.config.saved import ConfigSource, PendingConfig, Values
from coordinator.config.text import split_lines
from coordinator.dnc.files import Folder
from coordinator.ipc.protocol.methods import Caller, Scope
from coordinator.ipc.server.uploads import upload_method
from coordinator.service.jobs.job_folder import JobFolder
from coordinator.service.jobs.journal import NAME, SYNC_S, Journal, read_journal
from nodes.support.errors import CanductorError

Mark = Callable[[str], None]
Fault = tuple[int, int, int]
"""Mode, number of the call, errno."""
HALF: Final = -1
"""Version of what nobody wrote."""
NONE, ERROR, ERROR_ON, SHORT, KILL, KILL_TORN = range(6)
RESULTS: Final = "results"


class Writer(ABC):
    """Writes versions of something into a folder, and reads which one is there."""

    name: str
    versions: int

    @abstractmethod
    def prepare(self, folder: Path) -> None:
        """Write version 0."""

    @abstractmethod
    def write(self, folder: Path, mark: Mark) -> str:
        """Write all versions; return a sentence, or raise CanductorError, when that fails."""

    @abstractmethod
    def read(self, folder: Path) -> list[int]:
        """Return which versions may be there; HALF: something else is."""


class ConfigWriter(Writer):
    """SAVE_CONFIG."""

    name = "config"
    versions = 14
    _OWN: Final = b"[printer]\nkinematics: none\n; what the user wrote\n"

    def prepare(self, folder: Path) -> None:
        (folder / "printer.cfg").write_bytes(self._OWN)

    @staticmethod
    def _saved(data: bytes) -> Values:
        _, header, block = data.partition(SAVED_HEADER.encode())
        return parse_saved("", split_lines(header + block, "")) if header else {}

    def write(self, folder: Path, mark: Mark) -> str:
        path = folder / "printer.cfg"
        data = path.read_bytes()
        pending = PendingConfig(ConfigSource(str(path), data, self._saved(data), _accept))
        for version in range(1, self.versions + 1):
            mark(f"begun {version}")
            pending.put("extruder", "pid_kp", str(version))
            pending.put("heater_bed", "pid_kp", str(version))
            pending.write()
            mark(f"done {version}")
        return ""

    def read(self, folder: Path) -> list[int]:
        data = (folder / "printer.cfg").read_bytes()
        if data == self._OWN:
            return [0]
        try:
            values = self._saved(data)
        except CanductorError:
            return [HALF]
        kp = {options.get("pid_kp", "") for options in values.values()}
        if not data.startswith(self._OWN) or len(values) != 2 or len(kp) != 1:
            return [HALF]
        return [int(kp.pop())]


class JournalWriter(Writer):
    """The journal of a job that follows an interrupted one, to its end; long enough to be written again."""

    name = "journal"
    versions = 60
    _HELD: Final = "x" * 6000

    def prepare(self, folder: Path) -> None:
        journal = Journal(folder / NAME, _never)
        journal.begin("before.gcode", 10, 10)
        journal.note(5, {"speed_factor": 5.0})
        journal.close(None)

    def write(self, folder: Path, mark: Mark) -> str:
        failures: list[str] = []
        now_s = 0.0
        journal = Journal(folder / NAME, failures.append, clock_s=lambda: now_s)
        mark("begun 1")
        journal.begin("part.gcode", 1000, 77)
        for version in range(2, self.versions):
            mark(f"begun {version}")
            now_s += SYNC_S / 2
            journal.note(version, {"speed_factor": float(version), "text": self._HELD})
        mark(f"begun {self.versions}")
        journal.end()
        journal.close(None)
        if not failures:
            mark(f"done {self.versions}")
        return "; ".join(failures)

    def read(self, folder: Path) -> list[int]:
        found = read_journal(folder / NAME)
        if found is None:
            return [1, self.versions]
        if (found.file, found.size_bytes, found.line) == ("before.gcode", 10, 5):
            return [0]
        is_one = (found.file, found.size_bytes) == ("part.gcode", 1000)
        return [found.line if is_one and found.held["speed_factor"] == found.line else HALF]


class UploadWriter(Writer):
    """Uploads that replace a file, at last one of a new name."""

    name = "upload"
    versions = 11

    def prepare(self, folder: Path) -> None:
        (folder / "part.gcode").write_text(self._text(0))

    @staticmethod
    def _text(version: int) -> str:
        return f"; version {version}\n" + f"G1 X{version} F600\n" * 600

    def write(self, folder: Path, mark: Mark) -> str:
        asyncio.run(self._write(folder, mark))
        return ""

    async def _write(self, folder: Path, mark: Mark) -> None:
        method, caller = upload_method(folder), Caller("a test", Scope.OPERATE)

        async def upload(**params: Any) -> None:
            answer = method.call(caller, method.check(params))
            assert not isinstance(answer, dict | list | str | int | float | bool | None)
            await answer

        for version in range(1, self.versions + 1):
            text, last = self._text(version), version == self.versions
            file, half = ("other.gcode" if last else "part.gcode"), len(text) // 2
            mark(f"begun {version}")
            await upload(file=file, offset=0, text=text[:half], replace=not last)
            await upload(file=file, offset=half, text=text[half:], done=True, replace=not last)
            mark(f"done {version}")

    def read(self, folder: Path) -> list[int]:
        names = {job.name for job in JobFolder(folder).files()}
        texts = {self._text(version): version for version in range(self.versions + 1)}
        found = {name: texts.get((folder / name).read_text(), HALF) for name in names}
        if found.get("other.gcode", self.versions) != self.versions or "part.gcode" not in found:
            return [HALF]
        return [max(found.values()) if HALF not in found.values() else HALF]


class DncWriter(Writer):
    """Files received over a serial line; the last one has a new name."""

    name = "dnc"
    versions = 11

    def prepare(self, folder: Path) -> None:
        (folder / "PART.h").write_bytes(self._data(0))

    @staticmethod
    def _data(version: int) -> bytes:
        return b"%d BEGIN\n" % version * 800

    def write(self, folder: Path, mark: Mark) -> str:
        for version in range(1, self.versions + 1):
            last = version == self.versions
            mark(f"begun {version}")
            kept = Folder(folder, overwrite=not last)
            try:
                incoming = kept.take("H", "OTHER" if last else "PART")
                try:
                    for line in self._data(version).splitlines():
                        incoming.write(line)
                except CanductorError:
                    incoming.drop()
                    raise
                incoming.keep()
            finally:
                kept.close()
            mark(f"done {version}")
        return ""

    def read(self, folder: Path) -> list[int]:
        kept = Folder(folder)
        names = [entry.name for entry in kept.files()]
        kept.close()
        known = {self._data(version): version for version in range(self.versions + 1)}
        found = {name: known.get((folder / name).read_bytes(), HALF) for name in names}
        if found.get("OTHER.h", self.versions) != self.versions or "PART.h" not in found:
            return [HALF]
        return [max(found.values()) if HALF not in found.values() else HALF]


class CarelessWriter(ConfigWriter):
    """Shows that the tool finds what is wrong: the file is written where it is."""

    name = "careless"

    def write(self, folder: Path, mark: Mark) -> str:
        for version in range(1, 3):
            mark(f"begun {version}")
            text = f"{SAVED_HEADER}\n" + "".join(
                f"#*# [{section}]\n#*# pid_kp = {version}\n" for section in ("extruder", "heater_bed")
            )
            (folder / "new").write_bytes(self._OWN + text.encode())
            (folder / "new").replace(folder / "printer.cfg")  # without fsync
            mark(f"done {version}")
        return ""


WRITERS: Final = {
    writer.name: writer for writer in (ConfigWriter(), JournalWriter(), UploadWriter(), DncWriter())
}
ALL: Final = {**WRITERS, CarelessWriter.name: CarelessWriter()}


@dataclass(frozen=True)
class Point:
    """What came of a call that failed or was the last."""

    writer: str
    mode: int
    error: int
    call: int
    sentence: str
    """Why it failed; empty: it did not."""
    begun: int
    done: int
    found: list[int]
    """Versions, directly after it."""
    then: list[int]
    """After all was written once more, without any fault."""
    left: list[str]
    """Names in the folder then."""


def _accept(path: str, data: bytes) -> None:
    """Load any configuration: what its options mean does not matter here."""


def _never(sentence: str) -> None:
    raise AssertionError(sentence)


class _Library:
    """The functions of disk_calls.c."""

    def __init__(self, path: str) -> None:
        self._calls = ctypes.CDLL(path)
        self._calls.disk_arm.argtypes = (*(ctypes.c_char_p,) * 2, ctypes.c_int, ctypes.c_long, ctypes.c_int)
        self._calls.disk_disarm.restype = ctypes.c_long

    def arm(self, folder: Path, record: Path, mode: int = NONE, call: int = 0, error: int = 0) -> None:
        self._calls.disk_arm(os.fsencode(folder), os.fsencode(record), mode, call, error)

    def disarm(self) -> int:
        return int(self._calls.disk_disarm())

    def mark(self, text: str) -> None:
        self._calls.disk_mark(text.encode())


def _fresh(folder: Path, writer: Writer) -> Path:
    path = folder / writer.name
    shutil.rmtree(path, ignore_errors=True)
    path.mkdir()
    writer.prepare(path)
    return path


def _record(library: _Library, folder: Path, writer: Writer) -> int:
    """Record all versions of WRITER, copy the folder before and after, and return the number of calls."""
    path = _fresh(folder, writer)
    shutil.copytree(path, folder / f"{writer.name}.before")
    library.arm(path, folder / f"{writer.name}.record")
    sentence = writer.write(path, library.mark)
    assert not sentence, sentence
    calls = library.disarm()
    shutil.copytree(path, folder / f"{writer.name}.after")
    return calls


def _marks(record: Path) -> tuple[int, int]:
    marks = {"begun": 0, "done": 0}
    for line in record.read_text().splitlines():
        word, _, rest = line.partition(" ")
        if word == "mark":
            name, number = rest.split()
            marks[name] = int(number)
    return marks["begun"], marks["done"]


def _fault(library: _Library, folder: Path, writer: Writer, fault: Fault) -> Point:
    mode, call, error = fault
    path, record = _fresh(folder, writer), folder / "fault.record"
    if mode in (KILL, KILL_TORN):
        child = os.fork()
        if child == 0:
            try:
                library.arm(path, record, mode, call, error)
                writer.write(path, library.mark)
            finally:
                os._exit(0)
        os.waitpid(child, 0)
        sentence = ""
    else:
        library.arm(path, record, mode, call, error)
        try:
            sentence = writer.write(path, library.mark)
        except CanductorError as failed:
            sentence = str(failed)
        finally:
            library.disarm()
    begun, done = _marks(record)
    found = writer.read(path)
    if writer.name in ("upload", "dnc"):
        (path / "other.gcode").unlink(missing_ok=True)  # the last version is a new file
        (path / "OTHER.h").unlink(missing_ok=True)
    again = writer.write(path, lambda _: None)
    assert not again, again
    left = sorted(entry.name for entry in path.iterdir())
    return Point(writer.name, mode, error, call, sentence, begun, done, found, writer.read(path), left)


def _points(calls: int, every: int) -> Iterator[Fault]:
    """Yield mode, call and error of every EVERYth point for so many CALLS, and all of the last two calls."""
    found = [
        (mode, call, error)
        for call in range(1, calls + 1)
        for mode, error in (
            (ERROR, errno.EIO),
            (ERROR, errno.ENOSPC),
            (ERROR_ON, errno.ENOSPC),
            (ERROR_ON, errno.EROFS),
            (SHORT, errno.ENOSPC),
            (KILL, 0),
            (KILL_TORN, 0),
        )
    ]
    yield from [point for n, point in enumerate(found) if n % every == 0 or point[1] > calls - 2]


def main() -> None:
    """Record every writer into FOLDER; try every EVERYth point, and write the results there."""
    library, folder, every = _Library(sys.argv[1]), Path(sys.argv[2]), int(sys.argv[3])
    with (folder / RESULTS).open("w") as results:
        for writer in ALL.values():
            calls = _record(library, folder, writer)
            if writer.name not in WRITERS:
                continue
            for fault in _points(calls, every):
                point = _fault(library, folder, writer, fault)
                results.write(json.dumps(asdict(point)) + "\n")


if __name__ == "__main__":
    main()
