"""Lines of a program that is still being written, such as those of a pipe."""

import contextlib
import queue
import threading
from typing import IO, Final

from coordinator.dnc.endpoint import NOT_YET, Pause
from coordinator.dnc.files import read_lines
from nodes.support.errors import CanductorError

QUEUED_LINES_MAX: Final = 64
"""Lines read ahead; with more, the writer of the pipe waits."""


class SlowSource:
    """The lines of a pipe, read by a thread, so that the serial line is served while no line arrives."""

    def __init__(self, content: IO[bytes], line_max: int) -> None:
        self._content = content
        self._line_max = line_max
        self._lines: queue.Queue[bytes | CanductorError | None] = queue.Queue(QUEUED_LINES_MAX)
        self._closing = threading.Event()
        threading.Thread(target=self._read, name="dnc drip", daemon=True).start()

    def next_line(self) -> bytes | Pause | None:
        """See Source."""
        try:
            line = self._lines.get_nowait()
        except queue.Empty:
            return NOT_YET
        if isinstance(line, CanductorError):
            raise line
        return line

    def close(self) -> None:
        """See Source: the thread ends with the next line that arrives."""
        self._closing.set()

    def _read(self) -> None:
        try:
            for line in read_lines(self._content, self._line_max):
                if not self._put(line):
                    return
        except CanductorError as error:
            self._put(error)
        except (OSError, ValueError) as error:  # ValueError: closed
            self._put(CanductorError(f"reading the program failed: {error}"))
        else:
            self._put(None)

    def _put(self, line: bytes | CanductorError | None) -> bool:
        while not self._closing.is_set():
            with contextlib.suppress(queue.Full):
                self._lines.put(line, timeout=0.1)
                return True
        return False
