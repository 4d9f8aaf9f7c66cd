"""Standard output and standard error while a machine moves: the loop does not wait until they are read."""

import logging
import os
import select
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Final, TextIO

from coordinator.front_ends.writing_thread import WritingThread

END_S: Final = 1.0
"""An output that nobody reads keeps a service no longer at its end."""


class Console:
    """Writes to STREAM, such as standard output; None: there is none.

    Where nobody reads it, because a pipe is full or Ctrl-S was pressed, lines wait, and what is too much is
    left out. Where it is closed, all of it is.
    """

    def __init__(self, stream: TextIO | None) -> None:
        self._fd = -1 if stream is None else stream.fileno()
        self._encoding = "utf-8" if stream is None else stream.encoding
        self._thread = WritingThread("console", self._write, "nobody read them")
        self.failure: OSError | None = None
        """Why something could not be written, the first time."""

    @property
    def is_behind(self) -> bool:
        """Whether something waits until what came before it is read."""
        return self._thread.is_behind

    def show(self, text: str) -> None:
        """Write the lines of TEXT."""
        self._thread.add(lambda: text)

    def show_as_it_is(self, text: str) -> None:
        """Write TEXT, with what moves the cursor of a terminal in it."""
        self._thread.add_as_it_is(text)

    def close(self, wait_s: float | None = END_S) -> None:
        """Wait until all is written, for WAIT_S at most (None: as long as it takes).

        Then nothing waits for this output any more.
        """
        if not self._thread.close(wait_s):
            with Path(os.devnull).open("wb") as nothing:
                os.dup2(nothing.fileno(), self._fd)

    def _write(self, text: str) -> None:
        # Not by the stream: the interpreter waits for its lock at the end.
        data = text.encode(self._encoding, errors="replace")
        try:
            while data and self._fd >= 0:
                try:
                    data = data[os.write(self._fd, data) :]
                except BlockingIOError:  # another program may have it so that writing does not wait
                    select.select([], [self._fd], [])
        except OSError as error:  # it is closed, or the disk is full
            self.failure = self.failure or error


class _Reports(logging.Handler):
    def __init__(self, console: Console) -> None:
        super().__init__()
        self._console = console

    def emit(self, record: logging.LogRecord) -> None:
        self._console.show(self.format(record))


@contextmanager
def asyncio_reports_to(console: Console) -> Iterator[None]:
    """Have CONSOLE show what asyncio reports of bugs inside; by itself it writes to standard error."""
    logger, handler = logging.getLogger("asyncio"), _Reports(console)
    logger.addHandler(handler)
    propagated, logger.propagate = logger.propagate, False
    try:
        yield
    finally:
        logger.removeHandler(handler)
        logger.propagate = propagated
