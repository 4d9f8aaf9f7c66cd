"""The journal of a job: up to which line it was carried out, so that this outlives whatever ends the service.

One small file for each job folder, outside it: front ends list what is in there. Each entry is a line of
JSON, appended by a thread of its own and brought to the disk every SYNC_S, at once if the head is about to
go up or down; a power cut costs the last entries and nothing else. A file beyond FILE_BYTES_MAX is written
again with what still counts: its head and its newest entry. So is one whose last entry could not be written:
half an entry must not spoil the next one. And so is one that somebody removed or changed meanwhile.
"""

import contextlib
import hashlib
import json
import os
import queue
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

from coordinator.support.atomic_file import atomic_write, sync_folder
from nodes.support.plain_json import read_json
from nodes.support.regular_file import open_regular, read_regular

NAME: Final = ".canductor-journal"
"""Of the one that earlier versions kept in the job folder."""
ENTRY_S: Final = 1.0
"""Entries are that far apart."""
SYNC_S: Final = 2.0
CLOSE_S: Final = 1.0
"""A disk that does not answer must not keep the service from ending."""
FILE_BYTES_MAX: Final = 262_144
WAITING_MAX: Final = 64
_VERSION: Final = 1
_ENCODER: Final = json.JSONEncoder(separators=(",", ":"))
_INT_END: Final = 2**63
_NUMBER_END: Final = 1e9
"""Of offsets, factors, temperatures and heights."""


@dataclass(frozen=True)
class Interrupted:
    """A job that was neither done nor ended by anybody."""

    file: str
    size_bytes: int
    modified_ns: int
    line: int
    """That was being carried out, or shortly before it."""
    held: Mapping[str, Any] = field(default_factory=dict)
    """What held there that the file does not say: offset, factors, heaters, fan."""
    fed: bool = False
    """Whether its lines came from a client: there is no file to go on with."""


def journal_path(state: Path, jobs: Path, kind: str = "journal") -> Path:
    """Return where the journal of the job folder JOBS is, in the folder STATE; or another file of KIND."""
    digest = hashlib.sha256(os.fsencode(jobs.absolute())).hexdigest()[:12]
    return state / f"{kind}-{digest}"


def read_journal(path: Path) -> Interrupted | None:
    """Return the job that the journal at PATH breaks off in, or None."""
    try:
        data = read_regular(path, 4 * FILE_BYTES_MAX)
    except OSError:
        return None
    head: dict[str, Any] | None = None
    last: dict[str, Any] = {}
    for line in data.split(b"\n"):
        entry = _entry(line)
        if entry is None:
            continue  # the last one, cut off
        if entry.get("ended"):
            head = None
        elif "file" in entry:
            head, last = entry, goes_on if isinstance(goes_on := entry.get("goes_on"), dict) else {}
        else:
            last = entry
    return None if head is None else _interrupted(head, last)


def _interrupted(head: Mapping[str, Any], last: Mapping[str, Any]) -> Interrupted | None:
    """Return what HEAD and the LAST entry say; None unless each value has its type and its range.

    The file is in a folder that others may write to.
    """
    file = head.get("file")
    numbers = [head.get("size"), head.get("modified_ns"), last.get("line")]
    size, modified_ns, line = (n if type(n) is int and n < _INT_END else -1 for n in numbers)
    if head.get("journal") != _VERSION or not isinstance(file, str) or min(size, modified_ns) < 0:
        return None
    if line < 1 or not _is_sound(last):
        return None
    return Interrupted(file, size, modified_ns, line, last, fed=head.get("fed") is True)


def _is_sound(held: Mapping[str, Any]) -> bool:
    """Return whether all in HELD can be used as what ``note`` got."""
    lists = {"offset": 4, "z": 2}
    return (
        all(_is_number(held.get(name, 1.0)) for name in ("speed_factor", "extrude_factor"))
        and all(
            held.get(name) is None
            or (
                isinstance(held[name], list) and len(held[name]) == count and all(map(_is_number, held[name]))
            )
            for name, count in lists.items()
        )
        and all(
            isinstance(held.get(name, {}), dict) and all(map(_is_number, held.get(name, {}).values()))
            for name in ("heaters", "fans")
        )
        and isinstance(held.get("excluded", []), list)
        and all(isinstance(name, str) for name in held.get("excluded", []))
    )


def _is_number(value: object) -> bool:
    return type(value) in (int, float) and abs(value) < _NUMBER_END  # type: ignore[arg-type]


def _entry(line: bytes) -> dict[str, Any] | None:
    try:
        entry = read_json(line)
    except ValueError:
        return None
    return entry if isinstance(entry, dict) else None


def _line(entry: Mapping[str, Any]) -> bytes:
    return _ENCODER.encode(entry).encode() + b"\n"


class Journal:
    """Writes the journal at PATH. ON_FAILURE gets a sentence, once. CLOCK_S is monotonic, in s."""

    def __init__(
        self,
        path: Path,
        on_failure: Callable[[str], None],
        *,
        clock_s: Callable[[], float] = time.monotonic,
    ) -> None:
        self._path = path
        self._on_failure = on_failure
        self._clock_s = clock_s
        self._waiting: queue.SimpleQueue[tuple[float, dict[str, Any]] | None] = queue.SimpleQueue()
        """Entries, and when each came."""
        self._failed = False
        self.left_out = 0
        """Entries for which there was no room: the disk is slow."""
        self._thread = threading.Thread(target=self._run, name="journal", daemon=True)
        self._thread.start()

    def begin(self, file: str, size_bytes: int, modified_ns: int, *, fed: bool = False) -> None:
        """Begin with a job; FED: one whose lines come from a client."""
        head = {"journal": _VERSION, "file": file, "size": size_bytes, "modified_ns": modified_ns}
        self._put(head | ({"fed": True} if fed else {}))

    def go_on(self, found: Interrupted) -> None:
        """Begin with a job that was interrupted as FOUND says; that counts until the first ``note``."""
        head = {"journal": _VERSION, "file": found.file, "size": found.size_bytes}
        where = {**found.held, "line": found.line}
        self._put(head | {"modified_ns": found.modified_ns, "goes_on": where})

    def note(self, line: int, held: Mapping[str, Any]) -> None:
        """Record that LINE is being executed, and the settings that hold there."""
        self._put({**held, "line": line})

    def end(self) -> None:
        """Record that the job ended, by itself or on request."""
        self._put({"ended": True})

    def close(self, wait_s: float | None = CLOSE_S) -> None:
        """Wait until all is on the disk, WAIT_S at most (None: as long as it takes)."""
        self._waiting.put(None)
        self._thread.join(wait_s)

    def _put(self, entry: dict[str, Any]) -> None:
        """Have ENTRY written; a slow disk may cost lines of a job, but never its begin or its end."""
        if "line" in entry and self._waiting.qsize() >= WAITING_MAX:
            self.left_out += 1
        else:
            self._waiting.put((self._clock_s(), entry))

    # ------------------------------------------------------------------------------------- the thread

    def _run(self) -> None:
        head: dict[str, Any] | None = None  # of the job that goes on
        size = FILE_BYTES_MAX  # an existing file is replaced
        unsynced_s: float | None = None  # since when
        heights: object = None  # of the last entry: an old one that is found would be relied on
        while True:
            try:
                found = self._waiting.get(timeout=None if unsynced_s is None else SYNC_S)
            except queue.Empty:
                size, unsynced_s = self._sync(size), None
                continue
            if found is None:
                self._sync(size)
                return
            at_s, entry = found
            if "file" in entry:
                head = entry
            try:
                size = self._write(head, entry, size)
                unsynced_s = at_s if unsynced_s is None else unsynced_s
            except OSError as error:
                self._fail(error)
                size = FILE_BYTES_MAX
            over = entry.get("ended") is True
            if size == FILE_BYTES_MAX and (over or entry is head):
                self._remove()  # what it says of an earlier job, or of this one, does not hold any more
            if over:
                head = None
            before, heights = heights, entry.get("z")
            if unsynced_s is not None and (at_s >= unsynced_s + SYNC_S or heights != before):
                size, unsynced_s = self._sync(size), None

    def _write(self, head: dict[str, Any] | None, entry: dict[str, Any], size: int) -> int:
        """Write ENTRY and return how large the file is then."""
        data = _line(entry)
        if entry is not head and size + len(data) <= FILE_BYTES_MAX and self._append(data, size):
            return size + len(data)
        whole = data if entry is head or head is None else _line(head) + data
        atomic_write(self._path, whole)
        return len(whole)

    def _append(self, data: bytes, size: int) -> bool:
        """Append DATA to the file of SIZE; return False where somebody removed, cut or replaced it."""
        try:
            fd = open_regular(self._path, os.O_WRONLY | os.O_APPEND)
        except OSError:
            return False
        try:
            if os.fstat(fd).st_size != size:
                return False
            while data:
                data = data[os.write(fd, data) :]
        finally:
            os.close(fd)
        return True

    def _sync(self, size: int) -> int:
        """Bring the file of SIZE to the disk; return its size, FILE_BYTES_MAX if it must be written again."""
        try:
            fd = open_regular(self._path)
            try:
                os.fsync(fd)
            finally:
                os.close(fd)
        except FileNotFoundError:
            pass  # nothing was ever written
        except OSError as error:  # what was appended may be lost, even if the next fsync succeeds
            self._fail(error)
            return FILE_BYTES_MAX
        return size

    def _remove(self) -> None:
        """Remove the file where it cannot be written: that takes no space."""
        with contextlib.suppress(OSError):
            self._path.unlink()
            sync_folder(self._path.parent)

    def _fail(self, error: OSError) -> None:
        if not self._failed:
            self._failed = True
            reason = (error.strerror or str(error)).lower()
            self._on_failure(
                f"the journal {self._path} cannot be written: {reason}; a job could not be resumed after a"
                " crash"
            )
