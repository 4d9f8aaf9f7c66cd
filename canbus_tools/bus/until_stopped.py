"""Ctrl-C, SIGTERM and SIGHUP as a flag, for tools that have something to bring to its end."""

import contextlib
import signal
from collections.abc import Iterator
from types import FrameType
from typing import Final

from nodes.support.termination import TERMINATION

_SIGNALS: Final = (signal.SIGINT, *TERMINATION)


class StopFlag:
    """Whether the user asked to stop."""

    def __init__(self) -> None:
        self.stopped = False


@contextlib.contextmanager
def stop_flag() -> Iterator[StopFlag]:
    """Give a flag that these signals set while this lasts; main thread. A second one ends at once."""
    flag = StopFlag()
    before = {number: signal.getsignal(number) for number in _SIGNALS}

    def set_flag(number: int, frame: FrameType | None) -> None:
        handler = before[signal.Signals(number)]
        if flag.stopped and callable(handler):
            handler(number, frame)
        flag.stopped = True

    for number in _SIGNALS:
        if before[number] is not signal.SIG_IGN:
            signal.signal(number, set_flag)
    try:
        yield flag
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
