"""Two pseudo-terminals joined by a cable of a given baud rate: what is written to one comes out of the other.

Characters are handed on when their last bit would have come, in pieces of 16 at most, as a UART's FIFO does.
"""

import os
import select
import threading
import time
import tty
from collections import deque
from collections.abc import Callable
from typing import Self

FIFO = 16
Change = Callable[[int, bytes], bytes]
"""Gets the number of the end that sends, and what it sends; returns what arrives."""


class Cable:
    """``names`` are the devices of its two ends. BAUD None: as fast as it goes."""

    def __init__(self, baud: float | None = None, bits: int = 10, change: Change | None = None) -> None:
        pairs = [os.openpty() for _ in range(2)]
        self._ours = [ours for ours, _ in pairs]
        self._theirs = [theirs for _, theirs in pairs]  # kept open, or our ends see a hang-up between users
        for end in self._theirs:
            tty.setraw(end)
        self.names = [os.ttyname(theirs) for theirs in self._theirs]
        self.carried = [0, 0]
        self._character_s = 0.0 if baud is None else bits / baud
        self._change = change
        self._wake, self._stop = os.pipe()
        self._thread = threading.Thread(target=self._run, name="cable")
        self._thread.start()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        os.close(self._stop)
        self._thread.join()
        for fd in (*self._ours, *self._theirs, self._wake):
            os.close(fd)

    def _run(self) -> None:
        waiting: list[deque[tuple[float, bytes]]] = [deque(), deque()]
        free_s = [0.0, 0.0]
        while True:
            due = [w[0][0] for w in waiting if w]
            timeout_s = max(min(due) - time.monotonic(), 0.0) if due else None
            ready, _, _ = select.select([*self._ours, self._wake], [], [], timeout_s)
            if self._wake in ready:
                return
            now_s = time.monotonic()
            for who in range(2):
                if self._ours[who] in ready:
                    self._take(who, now_s, waiting[who], free_s)
                while waiting[who] and waiting[who][0][0] <= now_s:
                    os.write(self._ours[1 - who], waiting[who].popleft()[1])

    def _take(self, who: int, now_s: float, waiting: deque[tuple[float, bytes]], free_s: list[float]) -> None:
        data = os.read(self._ours[who], 4096)
        self.carried[who] += len(data)
        if self._change is not None:
            data = self._change(who, data)
        for at in range(0, len(data), FIFO):
            piece = data[at : at + FIFO]
            free_s[who] = max(now_s, free_s[who]) + len(piece) * self._character_s
            waiting.append((free_s[who], piece))
