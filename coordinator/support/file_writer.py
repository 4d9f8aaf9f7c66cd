"""Files that threads write: who changes one waits for no disk."""

import threading
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from coordinator.support.atomic_file import replace_content


@dataclass(frozen=True, slots=True, eq=False)
class _Content:
    data: bytes
    on_failure: Callable[[OSError], None]


class FileWriter:
    """Writes each file in a thread of its own, atomically; of contents that come meanwhile, the last."""

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._unwritten: dict[Path, _Content] = {}

    def write(self, path: Path, data: bytes, on_failure: Callable[[OSError], None]) -> None:
        """Have the file at PATH hold DATA; ON_FAILURE is called in the thread if it cannot be written."""
        with self._changed:
            has_thread = path in self._unwritten
            self._unwritten[path] = _Content(data, on_failure)
        if not has_thread:
            threading.Thread(
                target=self._run, args=(path,), name=f"writer of {path.name}", daemon=True
            ).start()

    def unwritten(self, path: Path) -> bytes | None:
        """Return what the file at PATH is going to hold; None: what it holds is the newest."""
        with self._changed:
            content = self._unwritten.get(path)
        return None if content is None else content.data

    def wait(self, wait_s: float) -> bool:
        """Wait until all is written, WAIT_S at most; return whether it is."""
        with self._changed:
            return self._changed.wait_for(lambda: not self._unwritten, wait_s)

    def _run(self, path: Path) -> None:
        content: _Content | None = None
        while (newest := self._newer(path, content)) is not None:
            content = newest
            try:
                replace_content(path, content.data)
            except OSError as error:
                content.on_failure(error)

    def _newer(self, path: Path, done: _Content | None) -> _Content | None:
        """Return what is to be written after DONE; None if that was the last."""
        with self._changed:
            content = self._unwritten[path]
            if content is not done:
                return content
            del self._unwritten[path]
            self._changed.notify_all()
        return None
