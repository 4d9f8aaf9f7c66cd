"""The journal of a job: up to which line it was carried out, so that this outlives whatever ends the service.

One small file for each job folder, outside it: front ends list what is in there. Each entry is a line of
JSON, appended by a thread of its own and brought to the disk every SYNC_S; a power cut costs the last entries
and nothing else. A file beyond FILE_BYTES_MAX is written again with what still counts: its head and its
newest entry.
"""

import hashlib
import json
import os
import queue
import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

from coordinator.support.atomic_file import atomic_write

NAME: Final = ".canductor-journal"
"""Of the one that earlier versions kept in the job folder."""
ENTRY_S: Final = 1.0
"""Entries are that far apart."""
SYNC_S: Final = 2.0
FILE_BYTES_MAX: Final = 262_144
WAITING_MAX: Final = 64
_VERSION: Final = 1


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


def journal_path(state: Path, jobs: Path) -> Path:
    """Return where the journal of the job folder JOBS is, in the folder STATE."""
    digest = hashlib.sha256(os.fsencode(jobs.absolute())).hexdigest()[:12]
    return state / f"journal-{digest}"


def read_journal(path: Path) -> Interrupted | None:
    """Return the job that the journal at PATH breaks off in, or None."""
    try:
        with path.open("rb") as file:
            data = file.read(4 * FILE_BYTES_MAX)
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
            head, last = entry, {}
        else:
            last = entry
    try:
        if head is None or head["journal"] != _VERSION or int(last.get("line", 0)) < 1:
            return None
        return Interrupted(
            str(head["file"]),
            int(head["size"]),
            int(head["modified_ns"]),
            int(last["line"]),
            last,
            fed=head.get("fed") is True,
        )
    except (KeyError, TypeError, ValueError):
        return None


def _entry(line: bytes) -> dict[str, Any] | None:
    try:
        entry = json.loads(line)
    except (ValueError, RecursionError):
        return None
    return entry if isinstance(entry, dict) else None


class Journal:
    """Writes the journal at PATH. ON_FAILURE gets a sentence, once."""

    def __init__(self, path: Path, on_failure: Callable[[str], None]) -> None:
        self._path = path
        self._on_failure = on_failure
        self._waiting: queue.Queue[dict[str, Any] | None] = queue.Queue(WAITING_MAX)
        self._failed = False
        self.left_out = 0
        """Entries for which there was no room: the disk is slow."""
        self._thread = threading.Thread(target=self._run, name="journal", daemon=True)
        self._thread.start()

    def begin(self, file: str, size_bytes: int, modified_ns: int, *, fed: bool = False) -> None:
        """Begin with a job; FED: one whose lines come from a client."""
        head = {"journal": _VERSION, "file": file, "size": size_bytes, "modified_ns": modified_ns}
        self._put(head | ({"fed": True} if fed else {}))

    def note(self, line: int, held: Mapping[str, Any]) -> None:
        """Record that LINE is being executed, and the settings that hold there."""
        self._put({**held, "line": line})

    def end(self) -> None:
        """Record that the job ended, by itself or on request."""
        self._put({"ended": True})

    def close(self) -> None:
        """Wait until all is on the disk."""
        self._waiting.put(None)
        self._thread.join()

    def _put(self, entry: dict[str, Any]) -> None:
        try:
            self._waiting.put_nowait(entry)
        except queue.Full:
            self.left_out += 1

    # ------------------------------------------------------------------------------------- the thread

    def _run(self) -> None:
        head: dict[str, Any] = {}
        size = FILE_BYTES_MAX  # an existing file is replaced
        unsynced = False
        while True:
            try:
                entry = self._waiting.get(timeout=SYNC_S if unsynced else None)
            except queue.Empty:
                self._sync()
                unsynced = False
                continue
            if entry is None:
                self._sync()
                return
            if "file" in entry:
                head = entry
            try:
                size = self._write(head, entry, size)
                unsynced = True
            except OSError as error:
                self._fail(error)

    def _write(self, head: dict[str, Any], entry: dict[str, Any], size: int) -> int:
        """Write ENTRY and return how large the file is then."""
        text = json.dumps(entry, separators=(",", ":")) + "\n"
        if entry is head or size + len(text) > FILE_BYTES_MAX:
            whole = text if entry is head else json.dumps(head) + "\n" + text
            atomic_write(self._path, whole.encode())
            return len(whole)
        with self._path.open("a", encoding="utf-8") as file:
            file.write(text)
        return size + len(text)

    def _sync(self) -> None:
        try:
            fd = os.open(self._path, os.O_RDONLY)
            try:
                os.fsync(fd)
            finally:
                os.close(fd)
        except FileNotFoundError:
            pass  # nothing was ever written
        except OSError as error:
            self._fail(error)

    def _fail(self, error: OSError) -> None:
        if not self._failed:
            self._failed = True
            reason = (error.strerror or str(error)).lower()
            self._on_failure(
                f"the journal {self._path} cannot be written: {reason}; a job could not be resumed after a"
                " crash"
            )
