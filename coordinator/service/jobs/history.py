"""The history of jobs: which ended lately, how and when.

A small file outside the job folder, next to the journal; written when a job has ended.
"""

import asyncio
import contextlib
import json
from collections import deque
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final

from coordinator.support.file_writer import FileWriter
from nodes.support.regular_file import read_regular

HISTORY_MAX: Final = 100
"""Jobs that are kept, the newest ones."""
_FILE_BYTES_MAX: Final = 1_048_576
_TEXT_MAX: Final = 2_000
_NUMBER_END: Final = 1e12


@dataclass(frozen=True, slots=True, kw_only=True)
class EndedJob:
    """One job that has ended."""

    file: str
    state: str
    """A JobPhase: done, cancelled, failed or stopped."""
    message: str
    """Why it failed or stopped."""
    ended_s: float
    """Since the epoch, by the computer's clock."""
    elapsed_s: float
    """From its start to its end, with pauses."""
    print_time_s: float
    """Pauses left out."""
    filament_mm: float
    """Drawn in by the extruder."""


class JobHistory:
    """The last HISTORY_MAX jobs, in memory, and once there is one in a file that FILES writes; on the loop.

    REPORT gets a sentence when the file cannot be written; the history in memory is complete nevertheless.
    """

    def __init__(self, report: Callable[[str], None], files: FileWriter) -> None:
        self._path: Path | None = None
        self._report = report
        self._files = files
        self._jobs: deque[EndedJob] = deque(maxlen=HISTORY_MAX)

    @property
    def jobs(self) -> list[EndedJob]:
        """The jobs, the newest first."""
        return list(reversed(self._jobs))

    def open(self, path: Path) -> None:
        """Keep it in the file at PATH, after what is in there; without effect when it is kept already."""
        if self._path is None:
            self._path = path
            self._jobs = deque([*_read(path), *self._jobs], maxlen=HISTORY_MAX)

    def add(self, job: EndedJob) -> None:
        """Add a job; the file follows."""
        self._jobs.append(job)
        if self._path is None:
            return
        path, loop = self._path, asyncio.get_running_loop()

        def fail(error: OSError) -> None:
            sentence = f"the history of jobs cannot be written to {path}: {error.strerror or error}"
            with contextlib.suppress(RuntimeError):  # the loop has ended
                loop.call_soon_threadsafe(self._report, sentence)

        data = json.dumps([asdict(ended) for ended in self._jobs], separators=(",", ":")).encode()
        self._files.write(path, data, fail)


def _read(path: Path) -> list[EndedJob]:
    """Return the jobs in the file at PATH; what is no job is left out."""
    try:
        found = json.loads(read_regular(path, _FILE_BYTES_MAX))
    except (OSError, ValueError, RecursionError):
        return []
    return [job for entry in found if (job := _job(entry)) is not None] if isinstance(found, list) else []


def _job(entry: Any) -> EndedJob | None:
    if not isinstance(entry, dict):
        return None
    texts = [entry.get(name) for name in ("file", "state", "message")]
    numbers = [entry.get(name) for name in ("ended_s", "elapsed_s", "print_time_s", "filament_mm")]
    if not all(isinstance(text, str) and len(text) <= _TEXT_MAX for text in texts):
        return None
    if not all(isinstance(number, int | float) and abs(number) < _NUMBER_END for number in numbers):
        return None
    return EndedJob(**{name: entry[name] for name in EndedJob.__dataclass_fields__})
