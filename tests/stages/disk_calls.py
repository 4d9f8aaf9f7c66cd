"""What a disk may hold after a power cut, from a record of the calls that changed a folder (disk_calls.c).

A power cut may keep all that was done, or only what fsync brought to the disk, or much in between: names
without the content of their files, content without names, a part of the last write.
Changes of names reach the disk in their order, as on every disk with a journal.
"""

import os
import shutil
import subprocess
import sys
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

import pytest

SOURCE: Final = Path(__file__).with_suffix(".c")
ROOT: Final = Path(__file__).parents[2]
FOLDER: Final = 0
"""Stands for the folder's inode in a record."""
FLAGS: Final = ("-std=gnu11", "-Wall", "-Wextra", "-Wconversion", "-Werror", "-O1", "-shared", "-fPIC")


def build(folder: Path) -> Path:
    """Return the library for LD_PRELOAD, built in FOLDER; skips without gcc."""
    if shutil.which("gcc") is None:
        pytest.skip("there is no gcc")
    library = folder / "disk_calls.so"
    subprocess.run(["gcc", *FLAGS, "-o", library, SOURCE, "-ldl"], check=True)
    return library


def run_worker(library: Path, folder: Path, *words: str) -> None:
    """Run tests.stages.disk_worker with the library; it writes what it found into FOLDER."""
    subprocess.run(
        [sys.executable, "-m", "tests.stages.disk_worker", str(library), str(folder), *words],
        env={**os.environ, "LD_PRELOAD": str(library)},
        cwd=ROOT,
        check=True,
    )


@dataclass(frozen=True)
class Change:
    """One line of a record."""

    kind: str
    inode: int = 0
    at: int = 0
    data: bytes = b""
    name: str = ""
    new_name: str = ""


def read_record(text: str) -> list[Change]:
    """Return the changes in the record TEXT."""
    found = []
    for line in text.splitlines():
        kind, _, rest = line.partition(" ")
        match kind:
            case "create":
                inode, _, name = rest.partition(" ")
                found.append(Change(kind, int(inode), name=name))
            case "write":
                inode, at, data = (*rest.split(" "), "")[:3]
                found.append(Change(kind, int(inode), int(at), bytes.fromhex(data)))
            case "cut":
                inode, at = rest.split(" ")
                found.append(Change(kind, int(inode), int(at)))
            case "sync":
                found.append(Change(kind, int(rest)))
            case "rename" | "link":
                name, _, new_name = rest.partition("\t")
                found.append(Change(kind, name=name, new_name=new_name))
            case _:
                found.append(Change(kind, name=rest))
    return found


@dataclass
class _File:
    durable: bytes = b""
    pending: list[Change] = field(default_factory=list)

    def content(self, count: int | None = None) -> bytes:
        """Return the content with the first COUNT of the pending changes; None: with all."""
        data = self.durable
        for change in self.pending[:count]:
            data = _changed(data, change)
        return data


def _changed(data: bytes, change: Change) -> bytes:
    if change.kind == "cut":
        return data[: change.at].ljust(change.at, b"\0")
    return data[: change.at].ljust(change.at, b"\0") + change.data + data[change.at + len(change.data) :]


@dataclass(frozen=True)
class CrashState:
    """What is found after the computer went off behind the first CHANGES of a record."""

    changes: int
    how: str
    begun: int
    """Version that was being written, or written last."""
    done: int
    """Version whose writer was told that it is done."""
    files: Mapping[str, bytes]


class Disk:
    """A folder as a record leaves it; BEFORE: what was on the disk before."""

    def __init__(self, before: Mapping[str, bytes]) -> None:
        self._files = {-number: _File(data) for number, data in enumerate(before.values(), 1)}
        self._durable = dict(zip(before, self._files, strict=True))
        self._pending: list[Change] = []
        self.begun = self.done = 0
        self.changes = 0

    def apply(self, change: Change) -> None:
        """Do one change."""
        self.changes += 1
        match change.kind:
            case "mark":
                word, number = change.name.split()
                setattr(self, word, int(number))
            case "sync" if change.inode == FOLDER:
                self._durable = self._names()
                self._pending.clear()
            case "sync":
                file = self._file(change.inode)
                file.durable = file.content()
                file.pending.clear()
            case "write" | "cut":
                self._file(change.inode).pending.append(change)
            case _:
                if change.kind == "create":
                    self._files[change.inode] = _File()
                self._pending.append(change)

    def _file(self, inode: int) -> _File:
        """Return a file; one that was there before has another number in the record."""
        if inode not in self._files:
            raise KeyError(f"the record changes file {inode}, which it did not create")
        return self._files[inode]

    def _names(self, count: int | None = None) -> dict[str, int]:
        names = dict(self._durable)
        for change in self._pending[:count]:
            match change.kind:
                case "create":
                    names[change.name] = change.inode
                case "rename":
                    names[change.new_name] = names.pop(change.name)
                case "link":
                    names[change.new_name] = names[change.name]
                case "unlink":
                    names.pop(change.name)
        return names

    def now(self) -> dict[str, bytes]:
        """Return what every program sees."""
        return {name: self._files[inode].content() for name, inode in self._names().items()}

    def states(self) -> Iterator[CrashState]:
        """Yield what a power cut may leave now."""
        for names in range(len(self._pending) + 1):
            yield self._state(f"{names} names, all content", names, None)
            yield self._state(f"{names} names, synced content", names, 0)
        last = [file for file in self._files.values() if file.pending]
        for file in last:
            change = file.pending[-1]
            for cut in sorted({1, len(change.data) // 2, len(change.data) - 1}):
                if change.kind == "write" and 0 < cut < len(change.data):
                    kept = Change("write", change.inode, change.at, change.data[:cut])
                    zeros = Change("write", change.inode, change.at, bytes(len(change.data)))
                    for torn in (kept, zeros):
                        file.pending[-1] = torn
                        yield self._state(f"a write torn at {cut}", None, None)
                    file.pending[-1] = change

    def _state(self, how: str, names: int | None, content: int | None) -> CrashState:
        found = {name: self._files[inode].content(content) for name, inode in self._names(names).items()}
        return CrashState(self.changes, how, self.begun, self.done, found)


def crash_states(before: Mapping[str, bytes], record: list[Change]) -> Iterator[CrashState]:
    """Yield what may be found after a power cut behind each change of RECORD."""
    disk = Disk(before)
    yield from disk.states()
    for change in record:
        disk.apply(change)
        yield from disk.states()


def end_state(before: Mapping[str, bytes], record: list[Change]) -> dict[str, bytes]:
    """Return the folder at the end of RECORD, as every program sees it."""
    disk = Disk(before)
    for change in record:
        disk.apply(change)
    return disk.now()
