"""Lines that a thread of its own writes: who adds them waits for no disk, and for no paused terminal."""

import queue
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from typing import Final

from nodes.support.terminal import printable_lines

WAITING_MAX: Final = 2_000
"""Entries that wait to be written; what comes then is left out."""
LINE_CHARS_MAX: Final = 8_000

Text = Callable[[], str]
"""Returns what to write; called in the thread."""


class WritingThread:
    """Has WRITE write what is added, in a thread NAME.

    A line says where entries had to be left out, and WHY.
    """

    def __init__(self, name: str, write: Callable[[str], None], why: str) -> None:
        self._write = write
        self._why = why
        self._waiting: queue.Queue[Text | None] = queue.Queue(WAITING_MAX)
        self._left_out = 0
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._thread.start()

    @property
    def is_behind(self) -> bool:
        """Whether something waits to be written."""
        return not self._waiting.empty()

    def add(self, text: Text) -> None:
        """Have the lines written that TEXT returns; without effect when too many wait."""
        self._put(lambda: _lines(text()))

    def add_as_it_is(self, text: str) -> None:
        """Have TEXT written, in which nothing is replaced; without effect when too much waits."""
        self._put(lambda: text)

    def _put(self, text: Text) -> None:
        try:
            self._waiting.put_nowait(text)
        except queue.Full:
            self._left_out += 1

    def close(self, wait_s: float | None = None) -> bool:
        """Wait until all is written, at most WAIT_S (None: as long as it takes); return whether it is."""
        until_s = None if wait_s is None else time.monotonic() + wait_s
        with suppress(queue.Full):
            self._waiting.put(None, timeout=wait_s)
            self._thread.join(None if until_s is None else max(0.0, until_s - time.monotonic()))
        return not self._thread.is_alive()

    def _run(self) -> None:
        ended = False
        while not ended:
            texts = [self._waiting.get()]
            with suppress(queue.Empty):
                while len(texts) < WAITING_MAX:
                    texts.append(self._waiting.get_nowait())
            ended = None in texts
            written = [text() for text in texts if text is not None]
            if left_out := self._left_out:
                self._left_out -= left_out
                written.append(_lines(f"{left_out} entries were left out here: {self._why}"))
            self._write("".join(written))


def _lines(text: str) -> str:
    return "".join(f"{printable_lines(line)[:LINE_CHARS_MAX]}\n" for line in text.split("\n"))
